"""Torque pulses of a conformance run, and what is expected of the torque that a drive reports.

A pulse is up, twice as long down, up again. It brings a free joint back to rest near where it was,
and shows the reported torque with either sign.
"""

from dataclasses import dataclass

from drivers.axis import AxisStatus
from hil.conform_bench import Bench, StepError

PLATEAU_CYCLES = 12
"""Length of the shortest pulse's first part, but for the cycles between two reports."""
JUDGED_CYCLES = 4
"""Torque is judged over so many cycles before each part ends."""
RESOLUTION_STEPS = 3
"""Reported torque may always be off by so many of its own steps."""
NOISE_SHARE = 0.1
"""Torque that counts as none, as a share of `Limits.torque_Nm`."""
DECAY_CYCLES = 3
"""Cycles in which the winding's current may die away and the report of it arrive."""


@dataclass(frozen=True, slots=True)
class Pulse:
    """What a drive did during one pulse."""

    up_Nm: float
    """Mean reported torque of the first part's end."""
    down_Nm: float
    """The same of the second part."""
    largest_Nm: float
    """Largest magnitude reported."""
    high_rad: float
    """Farthest the joint was above its start while the first two parts balanced."""
    low_rad: float
    """Farthest below, as a negative number."""


def pulse(bench: Bench, tau_Nm: float, cycles: int) -> Pulse:
    """Run +tau for `cycles`, -tau for twice as many, +tau again, and none after that.

    Raises:
        StepError: If the axis does not stay enabled, or a limit was broken.
    """
    start_rad = bench.axis.q_rad
    angles: list[float] = []
    torques: list[float] = []
    for part, sign in ((cycles, 1.0), (2 * cycles, -1.0), (cycles, 1.0), (cycles, 0.0)):
        for _ in range(part):
            bench.cycle(sign * tau_Nm)
            bench.expect_status(AxisStatus.ENABLED)
            torques.append(bench.axis.tau_meas_Nm)
            angles.append(bench.axis.q_rad - start_rad)
    return Pulse(
        up_Nm=_mean_before(torques, cycles),
        down_Nm=_mean_before(torques, 3 * cycles),
        largest_Nm=max(abs(tau) for tau in torques),
        high_rad=max(angles[: 2 * cycles]),
        low_rad=min(angles[: 2 * cycles]),
    )


def plateau(bench: Bench) -> int:
    """Return how many cycles a torque has to be held to be reported for certain."""
    return PLATEAU_CYCLES + 2 * bench.report_cycles


def _mean_before(values: list[float], end: int) -> float:
    part = values[end - JUDGED_CYCLES : end]
    return sum(part) / len(part)


def torque_resolution_Nm(bench: Bench) -> float:
    """Return the drive's own step of torque."""
    return bench.info.torque_resolution_Nm if bench.info is not None else 0.0


def _noise_Nm(bench: Bench) -> float:
    return max(RESOLUTION_STEPS * torque_resolution_Nm(bench), NOISE_SHARE * bench.limits.torque_Nm)


def expect_torque(bench: Bench, what: str, found_Nm: float, wanted_Nm: float) -> None:
    """Refuse a reported torque that is not the commanded one."""
    allowed_Nm = max(
        bench.limits.tolerance * abs(wanted_Nm), RESOLUTION_STEPS * torque_resolution_Nm(bench)
    )
    if found_Nm * wanted_Nm < 0.0 and abs(found_Nm) > allowed_Nm:
        raise StepError(
            f"{what}: {wanted_Nm:+.3f} Nm commanded, {found_Nm:+.3f} Nm reported: the sign is "
            "wrong; check axes.N.direction"
        )
    if abs(found_Nm - wanted_Nm) > allowed_Nm:
        raise StepError(
            f"{what}: {wanted_Nm:+.3f} Nm commanded, {found_Nm:+.3f} Nm reported, more than "
            f"{allowed_Nm:.3f} Nm apart"
        )


def expect_no_torque(bench: Bench) -> None:
    """Refuse a reported torque that is more than noise."""
    if abs(bench.axis.tau_meas_Nm) > _noise_Nm(bench):
        raise StepError(f"{bench.axis.tau_meas_Nm:+.3f} Nm reported although there should be none")


def expect_torque_gone(bench: Bench) -> None:
    """Refuse torque that is still reported a moment after the drive left operation."""
    for _ in range(DECAY_CYCLES + 2 * bench.report_cycles):
        bench.listen()
    expect_no_torque(bench)
