"""Rigid links in pymunk, driven by joint torques and read at second order.

`Space.step(dt)` is leapfrog: it drifts the positions with the old velocities, then kicks the
velocities. Angles therefore stand half a substep before the rates. Four things keep the chain
second order in the substep: pivots that correct their whole error in one substep, angles read
half a substep ahead, bodies placed half a substep behind, and friction taken from rates
extrapolated to the middle of the substep.
"""

import math
from collections.abc import Callable, Sequence
from math import cos, hypot, inf, isfinite, sin, tanh
from typing import Any, cast

import pymunk

from sim_backend.bodies import make_stops, place_body
from sim_backend.drivetrain import Drivetrain, substep_refinement
from sim_backend.errors import PlantError, SimError
from sim_backend.friction import check_friction, free_mobilities, has_stribeck, make_friction
from sim_backend.linkage import chain_energy_J, link_motions, outstretched_inertias_kg_m2
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


class Chain:
    """What the arm is made of: links, pivots, stops, friction and drivetrains.

    Attributes:
        settings: What the chain was built from.
        q_rad: Joint angles at `time_ns`, relative to the previous link. A new list at each step.
        dq_rad_s: Joint rates at `time_ns`. A new list at each step.
        time_ns: Simulated time.

    Raises:
        SimError: If the substep cannot carry friction or a drivetrain.
    """

    __slots__ = (
        "_bodies",
        "_drivetrains",
        "_friction",
        "_half_s",
        "_joints",
        "_levers_m",
        "_links",
        "_load_Nm",
        "_rates_before",
        "_read_out",
        "_resistances",
        "_space",
        "_substep_ns",
        "_substep_s",
        "dq_rad_s",
        "q_rad",
        "settings",
        "time_ns",
    )

    q_rad: list[float]
    dq_rad_s: list[float]
    _rates_before: list[float]

    def __init__(self, settings: PlantSettings) -> None:
        links, slope = settings.links, settings.tanh_slope_s_rad
        self.settings = settings
        self.time_ns = 0
        self._links = links
        self._substep_ns = _substep_ns(settings)
        self._substep_s = self._substep_ns * 1e-9
        self._half_s = 0.5 * self._substep_s
        check_friction(links, slope, self._substep_s)
        self._friction = [(link.viscous_Nms_rad, link.coulomb_Nm) for link in links]
        self._resistances = [make_friction(link, slope) for link in links]
        self._drivetrains = [_make_drivetrain(link, slope, self._substep_s) for link in links]
        self._load_Nm = [0.0] * len(links)
        self._read_out = self._read_two if len(links) == 2 else self._read_chain

    @property
    def is_plain(self) -> bool:
        """Direct drive and friction as in the paper's eq. (1), at every joint."""
        return not any(has_stribeck(link) or link.drivetrain for link in self.settings.links)

    def energy_J(self) -> float:
        """Energy at `time_ns`: kinetic, of drivetrains, and potential, zero at the shoulder."""
        gravity = self.settings.gravity_m_s2
        energy_J = chain_energy_J(self._links, gravity, self.q_rad, self.dq_rad_s)
        for drivetrain, q_rad in zip(self._drivetrains, self.q_rad, strict=True):
            if drivetrain is not None:
                energy_J += drivetrain.energy_J(q_rad)
        return energy_J

    def joint_separation_m(self) -> float:
        """Largest distance between the two sides of a joint, over all joints."""
        gaps_m = []
        for joint in self._joints:
            inner = joint.a.local_to_world(joint.anchor_a)
            outer = joint.b.local_to_world(joint.anchor_b)
            gaps_m.append(hypot(inner.x - outer.x, inner.y - outer.y))
        return max(gaps_m) if isfinite(sum(gaps_m)) else inf

    def _build(self) -> None:
        """Make links and pivots anew from `_links`, where `q_rad` and `dq_rad_s` put them."""
        # Of each link, what it adds to the position of the last link's centre of mass.
        *inner, last = self._links
        self._levers_m = [*(link.length_m for link in inner), last.com_m]
        self._space = space = pymunk.Space()
        space.gravity = (self.settings.gravity_m_s2, 0.0)
        space.damping = 1.0
        space.collision_slop = 1e-5
        self._bodies: list[pymunk.Body] = []
        self._joints: list[pymunk.PivotJoint] = []
        before, anchor = space.static_body, (0.0, 0.0)
        for motion in link_motions(self._links, self.q_rad, self.dq_rad_s):
            body, link = place_body(motion), motion.link
            joint = pymunk.PivotJoint(before, body, anchor, (-link.com_m, 0.0))
            joint.error_bias = 0.0  # exactly: the whole error is corrected in one substep
            joint.collide_bodies = False
            space.add(body, joint, *make_stops(link, before, body))
            self._bodies.append(body)
            self._joints.append(joint)
            before, anchor = body, (link.length_m - link.com_m, 0.0)
        space.iterations = max(10, len(space.constraints) ** 2)
        self._drift(-self._half_s)
        for drivetrain, inertia in zip(
            self._drivetrains, outstretched_inertias_kg_m2(self._links), strict=True
        ):
            if drivetrain is not None:
                drivetrain.set_load(inertia)

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

    def _advance_optional(self, tau_Nm: Sequence[float], substeps: int) -> None:
        """As `_advance_chain`, with Stribeck friction, drivetrains and disturbances."""
        step, dt, bodies, load_Nm = self._space.step, self._substep_s, self._bodies, self._load_Nm
        parts = zip(bodies, self._resistances, self._drivetrains, strict=True)
        rows = list(enumerate(parts))[::-1]
        has_drivetrain = any(self._drivetrains)
        rates, before = self.dq_rad_s, self._rates_before
        q = self.q_rad
        for _ in range(substeps):
            if has_drivetrain:
                q = _differences(bodies, _read_angle)
            reaction = 0.0
            for i, (body, resistance, drivetrain) in rows:
                rate = rates[i]
                tau = tau_Nm[i]
                if drivetrain is not None:
                    tau = drivetrain.advance(tau, q[i], rate)
                tau += load_Nm[i] - resistance(1.5 * rate - 0.5 * before[i])
                _write_torque(body, tau - reaction)
                reaction = tau
            step(dt)
            before, rates = rates, _differences(bodies, _read_rate)
        self.dq_rad_s, self._rates_before = rates, before

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

    def _time_s(self) -> float:
        return self.time_ns * 1e-9


def _differences(
    bodies: Sequence[pymunk.Body], read: Callable[[pymunk.Body], float]
) -> list[float]:
    """Return what is read of each link, relative to the link before."""
    differences, base = [], 0.0
    for body in bodies:
        value = read(body)
        differences.append(value - base)
        base = value
    return differences


def _make_drivetrain(link: LinkSettings, slope_s_rad: float, substep_s: float) -> Drivetrain | None:
    if link.drivetrain is None:
        return None
    return Drivetrain(link.drivetrain, slope_s_rad, substep_s)


def _substep_ns(settings: PlantSettings) -> int:
    """Return the substep, cut up as the drivetrains need it.

    Raises:
        SimError: If the configured one does not divide the current loop's period, or would have to
            be cut up too finely.
    """
    substep_ns = round(settings.substep_s * 1e9)
    is_whole = math.isclose(substep_ns * 1e-9, settings.substep_s, rel_tol=1e-9)
    if not is_whole or CURRENT_LOOP_PERIOD_NS % substep_ns:
        raise SimError(
            f"substep_s = {settings.substep_s} does not divide the current loop's 500 us;"
            " take 500e-6, 250e-6, 125e-6 or 100e-6"
        )
    mobilities = free_mobilities(settings.links)
    parts = [
        substep_refinement(link.drivetrain, mobility, substep_ns)
        for link, mobility in zip(settings.links, mobilities, strict=True)
        if link.drivetrain is not None
    ]
    return substep_ns // max(parts, default=1)
