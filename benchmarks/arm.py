"""Cost of 1 ms of plant against the bare `Space.step` of pymunk on the same bodies and joints."""

from benchmarks import rig
from benchmarks.measure import (
    Samples,
    Target,
    alternate,
    median,
    percentile,
    ratio,
    row,
    times,
    title,
    us,
)
from sim_backend.arm import Arm

LINKS = (1, 2, 4, 7)
SUBSTEPS_S = (250e-6, 100e-6)
CURRENT_LOOP_S = 500e-6
TURNS, CALLS = 40, 100


def run(scale: float) -> list[Target]:
    title("arm", "1 ms of plant, driven arm with friction, against bare Space.step")
    row("", "arm p50", "arm p99", "real time", "Space.step", "arm/bare")
    for substep_s in SUBSTEPS_S:
        for links in LINKS:
            samples = _race(links, substep_s, round(TURNS * scale) + 2)
            p50, p99 = median(samples["arm"]), percentile(samples["arm"], 0.99)
            overhead = ratio(samples, "arm", "bare")
            bare = median(samples["bare"])
            label = f"{links} links, substep {substep_s * 1e6:.0f} us"
            row(label, us(p50), us(p99), times(1e3 / p50), us(bare), times(overhead))
    return []


def _race(links: int, substep_s: float, turns: int) -> Samples:
    settings = rig.chain(links, substep_s)
    arm, other = Arm(settings), Arm(settings)
    tau_Nm = [0.02 * (-1.0) ** j for j in range(links)]
    space_step, substeps = other._space.step, range(round(1e-3 / substep_s))

    def step_arm() -> None:
        arm.step(tau_Nm, CURRENT_LOOP_S)
        arm.step(tau_Nm, CURRENT_LOOP_S)

    def step_space() -> None:
        for _ in substeps:
            space_step(substep_s)

    return alternate({"arm": step_arm, "bare": step_space}, turns=turns, calls=CALLS)
