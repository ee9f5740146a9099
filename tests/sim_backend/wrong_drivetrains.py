"""Drivetrains with one mistake each, for the tests that must catch them."""

from sim_backend.drivetrain import Drivetrain


class SampledContact(Drivetrain):
    """Torque at the middle of the substep, from extrapolated motion, instead of its mean."""

    def _solve_Nm(self, twist, twist_rate):
        rate = 1.5 * twist_rate - 0.5 * self._twist_rate_before
        return self._contact_Nm(twist, twist, rate)


class LightLink(Drivetrain):
    """Takes the link for lighter than it can be."""

    def set_load(self, inertia_kg_m2):
        super().set_load(0.3 * inertia_kg_m2)


class OneFlank(Drivetrain):
    def _contact_Nm(self, start, end, rate):
        return max(super()._contact_Nm(start, end, rate), 0.0)


class HalfTheGap(Drivetrain):
    def __init__(self, settings, slope_s_rad, substep_s):
        super().__init__(settings, slope_s_rad, substep_s)
        self._half_gap *= 0.5


class PullingDamper(Drivetrain):
    def _flank_Nm(self, start, end, rate):
        if start <= 0.0 or end <= 0.0:
            return super()._flank_Nm(start, end, rate)
        return 0.5 * self._stiffness * (start + end) + self._damping * rate


class NoDamper(Drivetrain):
    def __init__(self, settings, slope_s_rad, substep_s):
        super().__init__(settings, slope_s_rad, substep_s)
        self._damping = 0.0


class LateTorque(Drivetrain):
    """The link feels the torque of the substep before."""

    def advance(self, tau_Nm, link_rad, link_rad_s):
        before = self.torque_Nm
        super().advance(tau_Nm, link_rad, link_rad_s)
        return before


class NoRotorFriction(Drivetrain):
    def __init__(self, settings, slope_s_rad, substep_s):
        super().__init__(settings, slope_s_rad, substep_s)
        self._friction = lambda _rate: 0.0


class ShiftedRotor(Drivetrain):
    """Placed without stepping back by half a substep."""

    def place(self, q_rad, dq_rad_s, link_rad, link_rad_s):
        super().place(q_rad, dq_rad_s, link_rad, link_rad_s)
        self._angle_rad = q_rad
