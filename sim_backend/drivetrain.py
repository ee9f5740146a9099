"""A rotor in front of its joint, behind a gap with compliant flanks (backlash).

The flanks are a stiff spring each, with a damper that never pulls:

    tau = k s + d ds/dt if that and s are positive, else 0; s = |theta - q| - gap / 2

The rotor moves in the arm's substeps: rates at their ends, angles half a substep before. The
torque over a substep is the mean along the straight line on which the angles move, up to where
the torque itself takes them. With that mean the work of a spring is the change of its potential,
so that hitting and leaving a flank, in whatever part of a substep, does not create energy
(Gonzalez 1996, "Time integration and discrete Hamiltonian systems"). What the torque does to the
link's rate within the substep is taken from the largest inertia that it can meet, which errs
towards losing energy.
"""

from math import ceil, sqrt

from sim_backend.errors import SimError
from sim_backend.friction import make_friction
from sim_backend.settings import DrivetrainSettings

PHASE_MAX = 0.5
"""Largest phase, in rad, by which the contact may oscillate within one substep."""
REFINEMENT_MAX = 40
_ITERATIONS = 5
_TOLERANCE = 1e-12  # of the torque, relative to that of a penetration by 1 rad


class Drivetrain:
    """Rotor, gap and flanks of one joint; all seen at the joint.

    Args:
        settings: Rotor and flanks.
        slope_s_rad: D of the rotor's Coulomb friction.
        substep_s: In which `advance` moves.

    Attributes:
        settings: As given.
        torque_Nm: Mean torque on the link over the last substep.
    """

    __slots__ = (
        "_angle_rad",
        "_damping",
        "_friction",
        "_half_gap",
        "_half_s",
        "_mobility",
        "_per_inertia",
        "_rate_before",
        "_rate_rad_s",
        "_stiffness",
        "_substep_s",
        "_tolerance_Nm",
        "_twist_rate_before",
        "_weight",
        "settings",
        "torque_Nm",
    )

    def __init__(self, settings: DrivetrainSettings, slope_s_rad: float, substep_s: float) -> None:
        self.settings = settings
        self._friction = make_friction(settings, slope_s_rad)
        self._half_gap = 0.5 * settings.gap_rad
        self._stiffness, self._damping = settings.stiffness_Nm_rad, settings.damping_Nms_rad
        self._per_inertia = 1.0 / settings.rotor_inertia_kg_m2
        self._substep_s, self._half_s = substep_s, 0.5 * substep_s
        self._tolerance_Nm = _TOLERANCE * settings.stiffness_Nm_rad
        self.set_load(1.0)
        self.place(0.0, 0.0, 0.0, 0.0)

    @property
    def q_rad(self) -> float:
        """Rotor angle at the end of the last substep, relative to the previous link."""
        return self._angle_rad + self._half_s * self._rate_rad_s

    @property
    def dq_rad_s(self) -> float:
        """Rotor rate at the end of the last substep."""
        return self._rate_rad_s

    def set_load(self, inertia_kg_m2: float) -> None:
        """Say what the joint carries: the largest inertia that its torque can meet."""
        self._mobility = self._per_inertia + 1.0 / inertia_kg_m2
        # d(torque) / d(torque assumed), with a flank in contact.
        response = 0.25 * self._stiffness * self._substep_s + 0.5 * self._damping
        self._weight = 1.0 / (1.0 + self._substep_s * self._mobility * response)

    def place(self, q_rad: float, dq_rad_s: float, link_rad: float, link_rad_s: float) -> None:
        """Put the rotor somewhere, the link being at `link_rad`."""
        self._angle_rad = q_rad - self._half_s * dq_rad_s
        self._rate_rad_s = self._rate_before = dq_rad_s
        twist = q_rad - link_rad
        self.torque_Nm = self._contact_Nm(twist, twist, dq_rad_s - link_rad_s)
        self.rebase(link_rad_s)

    def rebase(self, link_rad_s: float) -> None:
        """Take note that the link's rate has jumped, or that there is no earlier one."""
        self._twist_rate_before = self._rate_rad_s - link_rad_s

    def energy_J(self, link_rad: float) -> float:
        """Kinetic energy of the rotor plus what the flanks store."""
        penetration = max(abs(self.q_rad - link_rad) - self._half_gap, 0.0)
        kinetic_J = 0.5 * self.settings.rotor_inertia_kg_m2 * self._rate_rad_s**2
        return kinetic_J + 0.5 * self._stiffness * penetration**2

    def advance(self, tau_Nm: float, link_rad: float, link_rad_s: float) -> float:
        """Move the rotor over one substep, and return the mean torque on the link.

        Args:
            tau_Nm: Motor torque.
            link_rad: Joint angle, half a substep before the substep begins.
            link_rad_s: Joint rate when it begins.
        """
        substep, rate = self._substep_s, self._rate_rad_s
        angle = self._angle_rad + substep * rate
        twist_rate = rate - link_rad_s
        twist = angle - link_rad - substep * link_rad_s  # in the middle of the substep
        torque = self._solve_Nm(twist, twist_rate)
        friction = self._friction(1.5 * rate - 0.5 * self._rate_before)
        self._angle_rad = angle
        self._rate_before = rate
        self._rate_rad_s = rate + substep * self._per_inertia * (tau_Nm - torque - friction)
        self._twist_rate_before = twist_rate
        self.torque_Nm = torque
        return torque

    def _solve_Nm(self, twist: float, twist_rate: float) -> float:
        """Return the torque that is the mean along the line to where it takes the twist itself."""
        half = self._half_s
        start = twist - half * twist_rate
        kick = self._substep_s * self._mobility
        torque = self.torque_Nm
        # The rate at the end if nothing touched: everything but the contact acts as it did.
        free = 2.0 * twist_rate - self._twist_rate_before + kick * torque
        for _ in range(_ITERATIONS):
            end_rate = free - kick * torque
            mean = self._contact_Nm(start, twist + half * end_rate, 0.5 * (twist_rate + end_rate))
            change = self._weight * (mean - torque)
            torque += change
            if -self._tolerance_Nm <= change <= self._tolerance_Nm:
                break
        return torque

    def _contact_Nm(self, start: float, end: float, rate: float) -> float:
        """Return the mean torque while the twist goes from `start` to `end`."""
        gap = self._half_gap
        torque = 0.0
        if start > gap or end > gap:
            torque = self._flank_Nm(start - gap, end - gap, rate)
        if start < -gap or end < -gap:
            torque -= self._flank_Nm(-start - gap, -end - gap, -rate)
        return torque

    def _flank_Nm(self, start: float, end: float, rate: float) -> float:
        """Return the mean of max(k s + d rate, 0) over the part of the line with s > 0."""
        stiffness, push = self._stiffness, self._damping * rate
        low, high = (start, end) if start < end else (end, start)
        touch = -push / stiffness if rate < 0.0 else 0.0
        if low >= touch:
            return 0.5 * stiffness * (low + high) + push
        if high <= touch:
            return 0.0
        share = (high - touch) / (high - low)
        return share * (0.5 * stiffness * (touch + high) + push)


def substep_refinement(settings: DrivetrainSettings, free_mobility: float, substep_ns: int) -> int:
    """Return into how many equal parts a substep must be cut for the contact to be followed.

    Args:
        settings: Rotor and flanks.
        free_mobility: 1 / (least inertia of the joint's links), in 1/(kg m^2).
        substep_ns: The substep.

    Raises:
        SimError: If more than `REFINEMENT_MAX` are needed.
    """
    mobility = free_mobility + 1.0 / settings.rotor_inertia_kg_m2
    pulsation = sqrt(settings.stiffness_Nm_rad * mobility)  # rad/s
    decay = settings.damping_Nms_rad * mobility
    parts = ceil(max(pulsation, decay) * substep_ns * 1e-9 / PHASE_MAX)
    whole = [n for n in range(max(parts, 1), REFINEMENT_MAX + 1) if substep_ns % n == 0]
    if not whole:
        raise SimError(
            f"a drivetrain with stiffness_Nm_rad = {settings.stiffness_Nm_rad:g},"
            f" damping_Nms_rad = {settings.damping_Nms_rad:g} and rotor_inertia_kg_m2 ="
            f" {settings.rotor_inertia_kg_m2:g} needs a substep of {substep_ns * 1e-3 / parts:.3g}"
            f" us, the limit is {substep_ns * 1e-3 / REFINEMENT_MAX:.3g} us; reduce stiffness or"
            " damping"
        )
    return whole[0]
