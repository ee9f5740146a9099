"""`PassivityLaw.step` with self-tuning gains against the same law in plain numpy.

Both are first run on the same motion and compared. The reference gets its measurements as arrays
and leaves its torques in one; what a loop would pay to convert them is not charged to it.
"""

import gc
import math
import resource
import sys
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import numpy as np

from benchmarks.measure import (
    Samples,
    Target,
    alternate_calls,
    at_least,
    at_most,
    percentile,
    row,
    times,
    title,
    us,
)
from benchmarks.plain_law import PlainLaw, Vector
from controller.law import PassivityLaw
from controller.player import Setpoint
from controller.settings import LawSettings

JOINTS = (2, 4, 8, 12)
DT_S = 1e-3
TOLERANCE = 1e-12
MOTION = 500
TURNS = 40
STEPS = 1_000_000
GROWTH_MAX_BLOCKS = 100
BOUNDS = {2: 3.0, 12: 1.0}
TAU_MAX_NM = 1.0  # low enough that the anti-windup acts in the motion


def run(scale: float) -> list[Target]:
    title("law", "self-tuning PID, one step, against plain numpy")
    row("", "ours p50", "ours p99", "numpy p50", "numpy p99", "numpy/ours")
    targets = []
    for joints in JOINTS:
        deviation = _compare(joints)
        samples = _race(joints, round(TURNS * scale) + 2)
        ratio = percentile(samples["numpy"], 0.5) / percentile(samples["ours"], 0.5)
        cells = [percentile(samples[name], p) for name in ("ours", "numpy") for p in (0.5, 0.99)]
        row(f"{joints} joints (equal within {deviation:.0e})", *map(us, cells), times(ratio))
        if joints in BOUNDS:
            targets.append(
                at_least(f"law: numpy over ours, {joints} joints", ratio, BOUNDS[joints])
            )
    blocks, resident_kB = _growth(round(STEPS * scale))
    row(f"growth over {round(STEPS * scale)} steps", f"{blocks} blocks", f"RSS {resident_kB:+d} kB")
    targets.append(at_most("law: allocated blocks gained", float(blocks), GROWTH_MAX_BLOCKS))
    return targets


def _settings(joints: int) -> LawSettings:
    return LawSettings(
        alpha=tuple(5.0 + 0.5 * j for j in range(joints)),
        lambda_=(10.0,) * joints,
        Ki=(0.2,) * joints,
        Kd=(4.0,) * joints,
        Kd_min=(1.0,) * joints,
        Kd_max=(4.0,) * joints,
        adaptation="literal",
        learning_rate=1e-4,
    )


Row = tuple[Vector, Vector, Vector, Vector]


def _motion(joints: int) -> list[Row]:
    """Return (q, dq, q_des, dq_des) of cycles with errors from none to saturating ones."""
    rows = []
    for cycle_ in range(MOTION):
        t = cycle_ * 0.02
        phase = np.arange(joints) * 0.7
        q_des, dq_des = np.sin(t + phase), np.cos(t + phase)
        amplitude = 0.3 * math.sin(0.9 * t) ** 4
        q = q_des + amplitude * np.sin(5.0 * t + phase)
        dq = dq_des + amplitude * 5.0 * np.cos(5.0 * t + phase)
        rows.append((q, dq, q_des, dq_des))
    return rows


Cycle = tuple[list[float], list[float], Setpoint]


def _as_lists(rows: list[Row]) -> list[Cycle]:
    cycles = []
    for row_ in rows:
        q, dq, q_des, dq_des = (vector.tolist() for vector in row_)
        cycles.append((q, dq, Setpoint(q_des, dq_des, [0.0] * len(q))))
    return cycles


def _compare(joints: int) -> float:
    """Return the largest deviation of torques, relative to 1 Nm.

    Raises:
        RuntimeError: If it is beyond 1e-12: the two are not the same law.
    """
    ours, plain = _pair(joints)
    rows = _motion(joints) * 4
    worst = 0.0
    saturated = 0
    for row_, lists in zip(rows, _as_lists(rows), strict=True):
        tau, tau_plain = ours.step(*lists, DT_S), plain.step(*row_, DT_S)
        worst = max(worst, float(np.max(np.abs(np.array(tau) - tau_plain))))
        saturated += max(map(abs, tau)) > TAU_MAX_NM
    if not worst < TOLERANCE or not saturated:
        raise RuntimeError(f"the laws differ by {worst:.3g} Nm, {saturated} cycles saturated")
    return worst


def _pair(joints: int) -> tuple[PassivityLaw, PlainLaw]:
    settings, limits = _settings(joints), [TAU_MAX_NM] * joints
    return PassivityLaw(settings, limits), PlainLaw(settings, np.array(limits))


def _race(joints: int, turns: int) -> Samples:
    ours, plain = _pair(joints)
    rows = _motion(joints)
    lists, arrays = cycle(_as_lists(rows)), cycle(rows)
    bodies: dict[str, Callable[[], object]] = {
        "ours": lambda: ours.step(*next(lists), DT_S),
        "numpy": lambda: plain.step(*next(arrays), DT_S),
    }
    return alternate_calls(bodies, turns=turns, calls=MOTION)


def _growth(steps: int) -> tuple[int, int]:
    """Return how many allocated blocks and kB of resident memory the steps leave behind."""
    law, _ = _pair(2)
    lists = _as_lists(_motion(2))
    for step in range(2 * MOTION):
        law.step(*lists[step % MOTION], DT_S)
    gc.collect()
    blocks, resident_kB = sys.getallocatedblocks(), _resident_kB()
    for step in range(steps):
        law.step(*lists[step % MOTION], DT_S)
    return sys.getallocatedblocks() - blocks, _resident_kB() - resident_kB


def _resident_kB() -> int:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() // 1024
