"""Simulated arms with one mistake each, for the tests that must catch them."""

from collections.abc import Sequence
from math import tanh

import pymunk

from sim_backend.arm import Arm


class DefaultBias(Arm):
    def _build(self):
        super()._build()
        for joint in self._joints:
            joint.error_bias = pymunk.PivotJoint(joint.a, joint.b, (0, 0), (0, 0)).error_bias


class TinyBias(Arm):
    def _build(self):
        super()._build()
        for joint in self._joints:
            joint.error_bias = 1e-300


class RawReadOut(Arm):
    def _read_two(self):
        super()._read_two()
        first, second = (body.angle for body in self._bodies)
        self.q_rad = [first, second - first]


class Damped(Arm):
    def _build(self):
        super()._build()
        self._space.damping = 0.9999


class HeavierLink(Arm):
    def __init__(self, settings):
        links = tuple(
            link.model_copy(update={"inertia_kg_m2": 1.01 * link.inertia_kg_m2})
            for link in settings.links
        )
        super().__init__(settings.model_copy(update={"links": links}))


class NoBackDrift(Arm):
    def _drift(self, dt_s):
        pass


class EulerFriction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        for _ in range(substeps):
            self._rates_before = self.dq_rad_s
            super()._advance_two(tau_Nm, 1)


class EulerStribeck(Arm):
    def _advance_optional(self, tau_Nm, substeps):
        for _ in range(substeps):
            self._rates_before = self.dq_rad_s
            super()._advance_optional(tau_Nm, 1)


class CoulombOnly(Arm):
    def __init__(self, settings):
        links = tuple(link.model_copy(update={"static_Nm": None}) for link in settings.links)
        super().__init__(settings.model_copy(update={"links": links}))


class FrozenFriction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        loss = [
            link.viscous_Nms_rad * dq + link.coulomb_Nm * tanh(self.settings.tanh_slope_s_rad * dq)
            for link, dq in zip(self.settings.links, self.dq_rad_s, strict=True)
        ]
        self._friction = [(0.0, 0.0)] * 2
        super()._advance_two([t - f for t, f in zip(tau_Nm, loss, strict=True)], substeps)


class NoReaction(Arm):
    def _advance_two(self, tau_Nm, substeps):
        super()._advance_two((tau_Nm[0] + tau_Nm[1], tau_Nm[1]), substeps)


class TorqueOnce(Arm):
    def _advance_two(self, tau_Nm, substeps):
        super()._advance_two(tau_Nm, 1)
        super()._advance_two((0.0, 0.0), substeps - 1)


class LateTorque(Arm):
    late_Nm: Sequence[float] = (0.0, 0.0)

    def step(self, tau_Nm, duration_s):
        super().step(self.late_Nm, duration_s)
        self.late_Nm = tau_Nm


class DifferencedRate:
    """A sound arm whose rate is read as the difference of two angles."""

    def __init__(self, settings):
        self.arm = Arm(settings)

    def reset(self, q_rad, dq_rad_s):
        self.arm.reset(q_rad, dq_rad_s)
        self.q_rad, self.dq_rad_s = self.arm.q_rad, self.arm.dq_rad_s

    def step(self, tau_Nm, duration_s):
        self.arm.step(tau_Nm, duration_s)
        pairs = zip(self.arm.q_rad, self.q_rad, strict=True)
        self.dq_rad_s = [(now - before) / duration_s for now, before in pairs]
        self.q_rad = self.arm.q_rad

    def energy_J(self):
        return self.arm.energy_J()

    def joint_separation_m(self):
        return self.arm.joint_separation_m()


class OneIteration(Arm):
    def _build(self):
        super()._build()
        self._space.iterations = 1


class Naive(DefaultBias, RawReadOut, NoBackDrift, EulerFriction):
    pass
