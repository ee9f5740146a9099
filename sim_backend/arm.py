"""The simulated arm: rigid links in pymunk, driven by joint torques, read at second order.

`Space.step(dt)` is leapfrog: it drifts the positions with the old velocities, then kicks the
velocities. Angles therefore stand half a substep before the rates. Four things keep the arm
second order in the substep: pivots that correct their whole error in one substep, angles read
half a substep ahead, bodies placed half a substep behind at a reset, and friction taken from
rates extrapolated to the middle of the substep.
"""

import math
from collections.abc import Callable, Sequence
from math import cos, hypot, inf, isfinite, sin, tanh
from typing import Any, cast

import pymunk

from sim_backend.errors import PlantError, SimError
from sim_backend.linkage import LinkMotion, chain_energy_J, link_motions
from sim_backend.settings import LinkSettings, PlantSettings

CURRENT_LOOP_PERIOD_NS = 500_000
DEVIATION_MAX_M = 1e-3  # of the last link; a sound arm stays below 1e-6 m at working speeds

# Calling a property's own function is cheaper than going through the attribute.
_read_angle = cast("Callable[[pymunk.Body], float]", cast("Any", pymunk.Body.angle).fget)
_read_rate = cast("Callable[[pymunk.Body], float]", cast("Any", pymunk.Body.angular_velocity).fget)
_read_position = cast(
    "Callable[[pymunk.Body], pymunk.Vec2d]", cast("Any", pymunk.Body.position).fget
)
_write_torque = cast("Callable[[pymunk.Body, float], None]", cast("Any", pymunk.Body.torque).fset)


class Arm:
    """A planar chain of n links on a fixed shoulder.

    Gravity acts along +x, so that angles count from the downward vertical, counter-clockwise
    positive. Joint friction is `B dq + C tanh(D dq)` (paper eq. (1)). Same settings and same
    calls give the same bits, on one machine type.

    Attributes:
        settings: What the arm was built from.
        q_rad: Joint angles at `time_ns`, relative to the previous link. A new list at each step.
        dq_rad_s: Joint rates at `time_ns`. A new list at each step.
        time_ns: Simulated time since the last reset.
        is_held: The arm stands still, whatever the torque; time goes on.

    Raises:
        SimError: If the settings contradict each other or the substep cannot carry the friction.

    Example:
        >>> from sim_backend.presets import plant_preset
        >>> arm = Arm(plant_preset("bench_h", q0_rad=(0.4, -0.5)))
        >>> arm.step((0.1, 0.0), 500e-6)
        >>> arm.time_ns
        500000
    """

    __slots__ = (
        "_advance",
        "_bodies",
        "_duration_s",
        "_friction",
        "_half_s",
        "_joints",
        "_levers_m",
        "_rates_before",
        "_read_out",
        "_space",
        "_substep_ns",
        "_substep_s",
        "_substeps",
        "dq_rad_s",
        "is_held",
        "q_rad",
        "settings",
        "time_ns",
    )

    def __init__(self, settings: PlantSettings) -> None:
        self.settings = settings
        self._substep_ns = _substep_ns(settings)
        self._substep_s = self._substep_ns * 1e-9
        self._half_s = 0.5 * self._substep_s
        _check_friction(settings, self._substep_s)
        self._friction = [(link.viscous_Nms_rad, link.coulomb_Nm) for link in settings.links]
        # Of each link, what it adds to the position of the last link's centre of mass.
        *inner, last = settings.links
        self._levers_m = [*(link.length_m for link in inner), last.com_m]
        is_two = len(settings.links) == 2
        self._advance = self._advance_two if is_two else self._advance_chain
        self._read_out = self._read_two if is_two else self._read_chain
        self._duration_s = self._substep_s
        self._substeps = 1
        self.reset(settings.q0_rad)

    def reset(self, q_rad: Sequence[float], dq_rad_s: Sequence[float] | None = None) -> None:
        """Rebuild the arm at a pose, at time zero, free.

        Args:
            q_rad: Joint angles.
            dq_rad_s: Joint rates; at rest if None.

        Raises:
            SimError: If the number of values is not the number of joints. Nothing has changed.
            PlantError: If a value is NaN or infinite. Nothing has changed.
        """
        count = len(self.settings.links)
        q, dq = list(q_rad), [0.0] * count if dq_rad_s is None else list(dq_rad_s)
        if len(q) != count or len(dq) != count:
            raise SimError(f"a pose of this arm has {count} joints: got q_rad={q}, dq_rad_s={dq}")
        if not isfinite(sum(q) + sum(dq)):
            raise PlantError(f"the pose is not finite: q_rad={q}, dq_rad_s={dq}")
        self.q_rad, self.dq_rad_s, self._rates_before = q, dq, dq
        self.time_ns = 0
        self.is_held = False
        self._build()

    def hold(self) -> None:
        """Stop the arm where it is, as on a stand, until `release`."""
        time_ns = self.time_ns
        self.reset(self.q_rad)
        self.time_ns = time_ns
        self.is_held = True

    def release(self) -> None:
        """Let a held arm move again."""
        self.is_held = False

    def step(self, tau_Nm: Sequence[float], duration_s: float) -> None:
        """Advance under constant motor torques.

        Args:
            tau_Nm: Motor torque per joint, positive about the joint's axis; reacts on the
                previous link.
            duration_s: A whole number of substeps.

        Raises:
            SimError: If `duration_s` or the number of torques does not fit. Nothing has moved.
            PlantError: If a torque is not finite (nothing has moved), or if the arm has come
                apart or left the range of numbers (it has moved; `reset` it).
        """
        if duration_s != self._duration_s:
            self._set_duration(duration_s)
        if len(tau_Nm) != len(self._bodies):
            raise SimError(f"this arm takes {len(self._bodies)} torques, not {len(tau_Nm)}")
        if not isfinite(sum(tau_Nm)):
            raise PlantError(f"torque is not finite at t = {self._time_s():.6f} s: {list(tau_Nm)}")
        self.time_ns += self._substeps * self._substep_ns
        if not self.is_held:
            self._advance(tau_Nm, self._substeps)
            try:
                self._read_out()
            except ValueError as error:  # the cosine of an infinite angle
                raise PlantError(self._describe_damage(inf)) from error

    def energy_J(self) -> float:
        """Kinetic plus potential energy at `time_ns`; the potential is zero at the shoulder."""
        return chain_energy_J(self.settings, self.q_rad, self.dq_rad_s)

    def joint_separation_m(self) -> float:
        """Largest distance between the two sides of a joint, over all joints."""
        gaps_m = []
        for joint in self._joints:
            inner = joint.a.local_to_world(joint.anchor_a)
            outer = joint.b.local_to_world(joint.anchor_b)
            gaps_m.append(hypot(inner.x - outer.x, inner.y - outer.y))
        return max(gaps_m) if isfinite(sum(gaps_m)) else inf

    def _build(self) -> None:
        self._space = space = pymunk.Space()
        space.gravity = (self.settings.gravity_m_s2, 0.0)
        space.damping = 1.0
        space.collision_slop = 1e-5
        space.iterations = max(10, len(self.settings.links) ** 2)
        self._bodies: list[pymunk.Body] = []
        self._joints: list[pymunk.PivotJoint] = []
        before, anchor = space.static_body, (0.0, 0.0)
        for motion in link_motions(self.settings.links, self.q_rad, self.dq_rad_s):
            body, link = _place_body(motion), motion.link
            joint = pymunk.PivotJoint(before, body, anchor, (-link.com_m, 0.0))
            joint.error_bias = 0.0  # exactly: the whole error is corrected in one substep
            joint.collide_bodies = False
            space.add(body, joint)
            self._bodies.append(body)
            self._joints.append(joint)
            before, anchor = body, (link.length_m - link.com_m, 0.0)
        self._drift(-self._half_s)

    def _drift(self, dt_s: float) -> None:
        for body in self._bodies:
            pymunk.Body.update_position(body, dt_s)

    def _advance_chain(self, tau_Nm: Sequence[float], substeps: int) -> None:
        step, dt, slope = self._space.step, self._substep_s, self.settings.tanh_slope_s_rad
        bodies = self._bodies
        rows = list(zip(range(len(bodies)), bodies, self._friction, strict=True))[::-1]
        rates, before = self.dq_rad_s, self._rates_before
        for _ in range(substeps):
            reaction = 0.0
            for i, body, (viscous, coulomb) in rows:
                rate = 1.5 * rates[i] - 0.5 * before[i]
                tau = tau_Nm[i] - viscous * rate - coulomb * tanh(slope * rate)
                _write_torque(body, tau - reaction)
                reaction = tau
            step(dt)
            before, rates, base = rates, [], 0.0
            for body in bodies:
                omega = _read_rate(body)
                rates.append(omega - base)
                base = omega
        self.dq_rad_s, self._rates_before = rates, before

    def _advance_two(self, tau_Nm: Sequence[float], substeps: int) -> None:
        """`_advance_chain` unrolled for two links, with the same bits."""
        step, dt, slope = self._space.step, self._substep_s, self.settings.tanh_slope_s_rad
        body_1, body_2 = self._bodies
        (viscous_1, coulomb_1), (viscous_2, coulomb_2) = self._friction
        demand_1, demand_2 = tau_Nm
        dq_1, dq_2 = self.dq_rad_s
        before_1, before_2 = self._rates_before
        for _ in range(substeps):
            rate = 1.5 * dq_2 - 0.5 * before_2
            tau_2 = demand_2 - viscous_2 * rate - coulomb_2 * tanh(slope * rate)
            rate = 1.5 * dq_1 - 0.5 * before_1
            tau_1 = demand_1 - viscous_1 * rate - coulomb_1 * tanh(slope * rate)
            _write_torque(body_1, tau_1 - tau_2)
            _write_torque(body_2, tau_2)
            step(dt)
            before_1, before_2 = dq_1, dq_2
            dq_1 = _read_rate(body_1)
            dq_2 = _read_rate(body_2) - dq_1
        self.dq_rad_s, self._rates_before = [dq_1, dq_2], [before_1, before_2]

    def _read_chain(self) -> None:
        """Refresh `q_rad` and check that the last link is where the angles put it."""
        half, q = self._half_s, []
        x = y = omega = base = 0.0
        for body, dq, lever in zip(self._bodies, self.dq_rad_s, self._levers_m, strict=True):
            omega += dq
            angle = _read_angle(body)
            x += lever * cos(angle)
            y += lever * sin(angle)
            ahead = angle + half * omega
            q.append(ahead - base)
            base = ahead
        self.q_rad = q
        self._check_tip(x, y)

    def _read_two(self) -> None:
        """`_read_chain` unrolled for two links, with the same bits."""
        half = self._half_s
        dq_1, dq_2 = self.dq_rad_s
        lever_1, lever_2 = self._levers_m
        angle_1, angle_2 = _read_angle(self._bodies[0]), _read_angle(self._bodies[1])
        ahead_1 = angle_1 + half * dq_1
        self.q_rad = [ahead_1, angle_2 + half * (dq_1 + dq_2) - ahead_1]
        self._check_tip(
            lever_1 * cos(angle_1) + lever_2 * cos(angle_2),
            lever_1 * sin(angle_1) + lever_2 * sin(angle_2),
        )

    def _check_tip(self, x_m: float, y_m: float) -> None:
        at_x_m, at_y_m = _read_position(self._bodies[-1])
        deviation_m = abs(x_m - at_x_m) + abs(y_m - at_y_m)
        if not deviation_m < DEVIATION_MAX_M:  # true of NaN, too
            raise PlantError(self._describe_damage(deviation_m))

    def _describe_damage(self, deviation_m: float) -> str:
        return (
            f"the arm came apart at t = {self._time_s():.6f} s: its last link is"
            f" {deviation_m:.3g} m from where the angles put it (limit {DEVIATION_MAX_M:g} m),"
            f" widest joint gap {self.joint_separation_m():.3g} m,"
            f" q_rad={self.q_rad}, dq_rad_s={self.dq_rad_s};"
            " check torques and inertias, or reduce substep_s"
        )

    def _set_duration(self, duration_s: float) -> None:
        ratio = duration_s / self._substep_s
        if not (ratio > 0.5 and isfinite(ratio) and abs(ratio - round(ratio)) < 1e-6):
            raise SimError(
                f"cannot advance by {duration_s} s: not a whole number of substeps of"
                f" {self._substep_s} s"
            )
        self._duration_s, self._substeps = duration_s, round(ratio)

    def _time_s(self) -> float:
        return self.time_ns * 1e-9


def _place_body(motion: LinkMotion) -> pymunk.Body:
    body = pymunk.Body(motion.link.mass_kg, motion.link.inertia_kg_m2)
    body.angle, body.angular_velocity = motion.angle_rad, motion.rate_rad_s
    body.position = (motion.x_m, motion.y_m)
    body.velocity = (motion.vx_m_s, motion.vy_m_s)
    return body


def _substep_ns(settings: PlantSettings) -> int:
    """Return the substep, checked to divide the current loop's period."""
    substep_ns = round(settings.substep_s * 1e9)
    is_whole = math.isclose(substep_ns * 1e-9, settings.substep_s, rel_tol=1e-9)
    if not is_whole or CURRENT_LOOP_PERIOD_NS % substep_ns:
        raise SimError(
            f"substep_s = {settings.substep_s} does not divide the current loop's 500 us;"
            " take 500e-6, 250e-6, 125e-6 or 100e-6"
        )
    return substep_ns


def _check_friction(settings: PlantSettings, substep_s: float) -> None:
    """Refuse friction so steep that its extrapolation over one substep would oscillate.

    The inertia a joint torque meets is at least that of its two links set free, which makes
    the check sufficient.
    """
    before: LinkSettings | None = None
    for number, link in enumerate(settings.links, 1):
        mobility = 1.0 / link.inertia_kg_m2 + (1.0 / before.inertia_kg_m2 if before else 0.0)
        slope_Nms = link.viscous_Nms_rad + link.coulomb_Nm * settings.tanh_slope_s_rad
        if slope_Nms * mobility * substep_s > 1.0:
            raise SimError(
                f"friction of joint {number} is too steep for a substep of {substep_s:g} s:"
                f" (B + C D) dt / I = {slope_Nms * mobility * substep_s:.3g}, limit 1;"
                " reduce substep_s or tanh_slope_s_rad"
            )
        before = link
