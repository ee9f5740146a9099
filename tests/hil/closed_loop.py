"""Closed-form closed loop, written apart from the product: 2-link dynamics, RK4, the paper's law.

Its runs validate metrics, bounds, recordings and reports without the loop they are made for.
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from hil.scenarios import KellyTrajectory, Scenario, VelocitySource, find_scenario
from hil.telemetry import SampleLayout

PERIOD_S = 1e-3
SUBSTEP_S = 500e-6
SUBSTEPS = 2
TANH_SLOPE_S_RAD = 50.0
ACTIVE = 3
BOUND_CYCLES = 2000
BOX = ((1.0, 1.0), (4.0, 4.0))
LAYOUT = SampleLayout(2, with_truth=True)


@dataclass(frozen=True)
class Arm:
    length_m: tuple[float, float]
    com_m: tuple[float, float]
    mass_kg: tuple[float, float]
    inertia_kg_m2: tuple[float, float]
    viscous_Nms_rad: tuple[float, float]
    coulomb_Nm: tuple[float, float]
    tau_max_Nm: tuple[float, float]


BENCH = Arm(
    (0.25, 0.25), (0.1, 0.1), (2.0, 0.8), (0.030, 0.032), (0.05, 0.01), (0.05, 0.01), (15.0, 8.0)
)
PELICAN = Arm(
    (0.26, 0.26),
    (0.0983, 0.0229),
    (6.5225, 2.0458),
    (0.1213, 0.0116),
    (0.10, 0.01),
    (0.20, 0.02),
    (25.0, 5.0),
)
ARMS = {"bench": BENCH, "pelican": PELICAN}


def memberships(s: float) -> tuple[float, float, float]:
    a = 1.0 / (1.0 + math.exp(min((0.20 - s) / 0.04, 700.0)))
    b = 1.0 / (1.0 + math.exp(min((0.60 - s) / 0.12, 700.0)))
    return b, max(a - b, 0.0), 1.0 - a


@dataclass(frozen=True)
class Law:
    """tau = -Kd S with the paper's gains; a wrong one is made with `replace`."""

    alpha: tuple[float, float] = (5.0, 7.5)
    lambda_: float = 10.0
    Ki: float = 0.2
    beta: tuple[float, float, float] = (1.0, 2.0, 4.0)  # big, medium, small
    learning_rate: float = 1e-6
    f: Callable[[float], float] = math.tanh
    degrees: Callable[[float], tuple[float, float, float]] = memberships  # of big, medium, small


def make_acceleration(arm: Arm, gravity_m_s2: float) -> Callable[..., tuple[float, float]]:
    """Accelerations of (1); q1 from the downward vertical, q2 relative."""
    l1, (c1, c2), (m1, m2), (i1, i2) = arm.length_m[0], arm.com_m, arm.mass_kg, arm.inertia_kg_m2
    (b1, b2), (f1, f2) = arm.viscous_Nms_rad, arm.coulomb_Nm
    h22 = i2 + m2 * c2 * c2
    coupling = m2 * l1 * c2
    straight = i1 + m1 * c1 * c1 + m2 * l1 * l1 + h22
    g1, g2 = (m1 * c1 + m2 * l1) * gravity_m_s2, m2 * c2 * gravity_m_s2
    sin, cos, tanh, D = math.sin, math.cos, math.tanh, TANH_SLOPE_S_RAD

    def acceleration(q1, q2, v1, v2, t1, t2):
        k, s = coupling * cos(q2), coupling * sin(q2)
        h11, h12, outer = straight + 2 * k, h22 + k, g2 * sin(q1 + q2)
        centrifugal = s * v2 * (2 * v1 + v2)
        r1 = t1 - b1 * v1 - f1 * tanh(D * v1) + centrifugal - g1 * sin(q1) - outer
        r2 = t2 - b2 * v2 - f2 * tanh(D * v2) - s * v1 * v1 - outer
        det = h11 * h22 - h12 * h12
        return (h22 * r1 - h12 * r2) / det, (h11 * r2 - h12 * r1) / det

    return acceleration


def rk4(f, state, torques, h):
    """One step; `torques` are those at its start, middle and end."""
    q1, q2, v1, v2 = state
    half = h / 2
    a1, a2 = f(q1, q2, v1, v2, *torques[0])
    u1, u2 = v1 + half * a1, v2 + half * a2
    b1, b2 = f(q1 + half * v1, q2 + half * v2, u1, u2, *torques[1])
    w1, w2 = v1 + half * b1, v2 + half * b2
    c1, c2 = f(q1 + half * u1, q2 + half * u2, w1, w2, *torques[1])
    x1, x2 = v1 + h * c1, v2 + h * c2
    d1, d2 = f(q1 + h * w1, q2 + h * w2, x1, x2, *torques[2])
    return (
        q1 + h / 6 * (v1 + 2 * u1 + 2 * w1 + x1),
        q2 + h / 6 * (v2 + 2 * u2 + 2 * w2 + x2),
        v1 + h / 6 * (a1 + 2 * b1 + 2 * c1 + d1),
        v2 + h / 6 * (a2 + 2 * b2 + 2 * c2 + d2),
    )


class FilteredDifference:
    def __init__(self, q: float, cutoff_Hz: float) -> None:
        self.q, self.v = q, 0.0
        self.share = 1 - math.exp(-2 * math.pi * cutoff_Hz * PERIOD_S)

    def step(self, q: float) -> float:
        self.v += self.share * ((q - self.q) / PERIOD_S - self.v)
        self.q = q
        return self.v


class Levant:
    def __init__(self, q: float, C: float) -> None:
        self.x, self.v, self.k1, self.k2 = q, 0.0, 1.5 * math.sqrt(C), 1.1 * C

    def step(self, q: float) -> float:
        error = self.x - q
        sign = (error > 0) - (error < 0)
        self.x += PERIOD_S * (self.v - self.k1 * math.sqrt(abs(error)) * sign)
        self.v -= PERIOD_S * self.k2 * sign
        return self.v


def make_estimators(velocity: VelocitySource, q) -> list[FilteredDifference | Levant] | None:
    if velocity.kind == "levant":
        return [Levant(x, C) for x, C in zip(q, velocity.levant_C_rad_s2, strict=True)]
    if velocity.kind == "filtered_difference":
        return [FilteredDifference(x, velocity.cutoff_Hz) for x in q]
    return None


def reference(trajectory: KellyTrajectory, t_s: float) -> tuple[list[float], list[float]]:
    r, s = trajectory.rate, trajectory.rate * t_s
    h, dh = 1 - math.exp(-2 * s**3), 6 * s * s * math.exp(-2 * s**3)
    q, dq = [], []
    for b, c, w in zip(trajectory.b_rad, trajectory.c_rad, trajectory.w_rad_s, strict=True):
        sine, cosine = math.sin(w * s), math.cos(w * s)
        q.append(h * (b + c * sine))
        dq.append(r * (dh * (b + c * sine) + h * c * w * cosine))
    return q, dq


class Controller:
    def __init__(self, scenario: Scenario, law: Law) -> None:
        self.law = law
        self.tau_max = ARMS[scenario.preset.split("_")[0]].tau_max_Nm
        self.rate = 0.0 if scenario.adaptation == "off" else law.learning_rate
        self.beta = [list(law.beta), list(law.beta)]
        self.sigma = [0.0, 0.0]

    def step(self, q, dq, q_des, dq_des):
        """S, Kd, requested and sent torque per joint; sigma moves on after use."""
        law, rows = self.law, []
        for j in (0, 1):
            S_q = dq[j] - dq_des[j] + law.alpha[j] * (q[j] - q_des[j])
            S = S_q + law.Ki * self.sigma[j]
            big, medium, small = law.degrees(abs(S))
            beta = self.beta[j]
            Kd = min(max(beta[0] * big + beta[1] * medium + beta[2] * small, 1.0), 4.0)
            sent = min(max(-Kd * S, -self.tau_max[j]), self.tau_max[j])
            if sent == -Kd * S or S_q * S < 0:
                self.sigma[j] += PERIOD_S * law.f(law.lambda_ * S_q)
            if self.rate:
                step = self.rate * S * law.alpha[j]
                moved = (beta[0] - step * big, beta[1] - step * medium, beta[2] - step * small)
                self.beta[j] = [min(max(b, 1.0), 4.0) for b in moved]
            rows.append((S, Kd, -Kd * S, sent))
        return [list(column) for column in zip(*rows, strict=True)]


class Monitors:
    """Storage, dissipation, demand and regions, written out plainly; the bound is added later."""

    def __init__(self) -> None:
        self.need = [0.0, 0.0]
        self.share = 1 - math.exp(-2 * math.pi * 5.0 * PERIOD_S)
        self.inside: list[bool] = []
        self.entries, self.exits = [0, 0], [0, 0]

    def step(self, S, Kd, sent):
        """Scalars and per-joint lists as they stand in a sample."""
        inside = [abs(s) < 1.0 for s in S]
        for j in (0, 1):
            self.need[j] += self.share * (sent[j] - self.need[j])
            if self.inside and inside[j] != self.inside[j]:
                (self.entries if inside[j] else self.exits)[j] += 1
        self.inside = inside
        dissipation = Kd[0] * S[0] ** 2 + Kd[1] * S[1] ** 2
        demand = abs(S[0] * self.need[0] + S[1] * self.need[1])
        scalars = ((S[0] ** 2 + S[1] ** 2) / 2, dissipation, demand, dissipation > demand)
        return scalars, (inside, self.entries, self.exits, self.need, (0.0, 0.0))


def run(scenario: Scenario, law: Law | None = None, duration_s: float | None = None):
    """Samples of one run as the loop would report them, one row a cycle."""
    arm, gravity = ARMS[scenario.preset.split("_")[0]], scenario.preset.endswith("_v")
    acceleration = make_acceleration(arm, 9.81 if gravity else 0.0)
    count = 2 * math.pi / 2**scenario.encoder_bits if scenario.encoder_bits else 0.0
    controller, monitors = Controller(scenario, law or Law()), Monitors()
    state = (*scenario.q0_rad, 0.0, 0.0)

    def read(q: float) -> float:
        return round(q / count) * count if count else q

    estimators = make_estimators(scenario.velocity, [read(q) for q in scenario.q0_rad])
    half = math.exp(-SUBSTEP_S / 2 / scenario.torque_lag_s)
    waiting = deque([(0.0, 0.0)] * round(scenario.torque_delay_s / SUBSTEP_S))
    cycles = round((duration_s or scenario.duration_s) / PERIOD_S)
    write, log = LAYOUT.writer(), bytearray(cycles * LAYOUT.size)
    torque = (0.0, 0.0)
    for k in range(cycles):
        q_des, dq_des = reference(scenario.trajectory, k * PERIOD_S)
        q_true, dq_true = state[:2], state[2:]
        q = [read(x) for x in q_true]
        dq = [e.step(x) for e, x in zip(estimators, q, strict=True)] if estimators else dq_true
        sigma = list(controller.sigma)
        S, Kd, cmd, sent = controller.step(q, dq, q_des, dq_des)
        mean = [0.0, 0.0]
        for _ in range(SUBSTEPS):
            waiting.append(sent)
            (g1, g2), (t1, t2) = waiting.popleft(), torque
            mid = (g1 + (t1 - g1) * half, g2 + (t2 - g2) * half)
            end = (g1 + (mid[0] - g1) * half, g2 + (mid[1] - g2) * half)
            state = rk4(acceleration, state, (torque, mid, end), SUBSTEP_S)
            mean[0] += (t1 + 4 * mid[0] + end[0]) / 6 / SUBSTEPS
            mean[1] += (t2 + 4 * mid[1] + end[1]) / 6 / SUBSTEPS
            torque = end
        busy_ns = 110_000 + k % 97 * 500
        stamps = (60_000 + k % 13 * 1_000, 350_000, 390_000, 400_000, busy_ns)
        scalars, lists = monitors.step(S, Kd, sent)
        head = (k, k, k * 1_000_000, ACTIVE, 0, 0, 0, *stamps, k * PERIOD_S, *scalars)
        motion = (q, dq, q_des, dq_des, S, sigma, Kd, *BOX, cmd, sent, torque, *lists)
        write(log, k * LAYOUT.size, head, (*motion, q_true, dq_true, mean))
    rows = np.frombuffer(log, LAYOUT.dtype)
    size = np.pad(np.abs(rows["S_rad_s"]), ((BOUND_CYCLES - 1, 0), (0, 0)))
    trailing = np.lib.stride_tricks.sliding_window_view(size, BOUND_CYCLES, axis=0)
    rows["S_bound_rad_s"] = trailing.max(axis=-1)
    return np.frombuffer(bytes(log), LAYOUT.dtype)


@cache
def run_named(name: str):
    """The run of a reference scenario, made once per test session; do not write to it."""
    return run(find_scenario(name))


def shortened(name: str, duration_s: float) -> Scenario:
    """A scenario cut short, statistics over its second half."""
    return replace(find_scenario(name), duration_s=duration_s, stat_start_s=duration_s / 2)


def payloads(rows) -> list[bytes]:
    """Serialise samples as the loop does."""
    write, buffer = LAYOUT.writer(), bytearray(LAYOUT.size)
    split, out = len(LAYOUT.scalar_names), []
    for row in rows.tolist():
        write(buffer, 0, row[:split], row[split:])
        out.append(bytes(buffer))
    return out
