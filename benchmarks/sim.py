"""Speed of `hil sim` over real time, with full frame encoding, and where its time goes.

The parts are timed alone, each with its own real objects and with the calls one cycle makes.
What is left over belongs to the state machine, the reference and the checks of `Control`.
"""

from collections.abc import Callable
from itertools import cycle

from benchmarks import rig
from benchmarks.measure import (
    Samples,
    Target,
    alternate,
    alternate_calls,
    at_least,
    median,
    percentile,
    row,
    times,
    title,
    us,
)
from controller.law import PassivityLaw
from controller.limits import MotionGuard, TorqueLimiter
from controller.velocity import make_estimator
from drivers.arm_bus import RECEIVED, SENT, ArmBus
from drivers.buses.loopback import LoopbackBus
from hil.config import Config
from hil.sampler import Sampler
from hil.simulation import NO_STAMPS, Simulation, open_recording
from hil.telemetry import SampleLayout
from sim_backend.arm import Arm

BLOCK_CYCLES = 250
TURNS = 40
PART_TURNS, PART_CALLS = 30, 200
CURRENT_LOOP_S = 500e-6
SYNC_ID, TPDO1_IDS = 0x080, range(0x181, 0x200)
REAL_TIME_MIN = 10.0
PLANT, SAMPLER = "of the emulator, plant: 2 x Arm.step", "sampler"


def run(scale: float) -> list[Target]:
    title("sim", "virtual time, 2 joints, full frame encoding, 250 us substeps, scenario A")
    row("", "wall p50", "wall p99", "cpu p50", "real time")
    config = rig.configuration()
    turns = round(TURNS * scale) + 2
    with rig.scratch_file("bench.mcap") as path, open_recording(config, path) as recording:
        plain, recorded = (
            rig.tracking_simulation(config),
            rig.tracking_simulation(config, recording),
        )
        blocks = {
            "without recording": lambda: plain.run(BLOCK_CYCLES),
            "with recording": lambda: recorded.run(BLOCK_CYCLES),
        }
        cpu = alternate(blocks, turns=turns, calls=1)
        wall = alternate_calls(blocks, turns=turns, calls=1)
        for name in blocks:
            p50, p99 = (percentile(wall[name], p) / BLOCK_CYCLES for p in (0.5, 0.99))
            cells = (us(p50), us(p99), us(median(cpu[name]) / BLOCK_CYCLES))
            row(f"1 ms {name}", *cells, times(1e3 / p50))
        _print_parts(config, recorded, round(PART_TURNS * scale) + 2, _per_cycle(cpu))
    return [
        at_least(f"sim: speed over real time, {name}", _speed(wall, name), REAL_TIME_MIN)
        for name in blocks
    ]


def _speed(wall: Samples, name: str) -> float:
    return 1e3 * BLOCK_CYCLES / median(wall[name])


def _per_cycle(cpu: Samples) -> tuple[float, float]:
    plain, recorded = (median(cpu[f"{how} recording"]) for how in ("without", "with"))
    return plain / BLOCK_CYCLES, recorded / BLOCK_CYCLES


def _print_parts(
    config: Config, simulation: Simulation, turns: int, whole: tuple[float, float]
) -> None:
    received, sent = capture_cycle(simulation)
    plain_us, recorded_us = whole
    bodies: dict[str, Callable[[], object]] = {
        PLANT: _plant(config),
        "emulator: plant, servos, nodes, frames": _emulator(config, sent),
        "drivers: ArmBus and axes on canned frames": _drivers(config, received),
        "estimator, guard, limiter": _checks(config),
        "law": _law(config),
        SAMPLER: _sampler(simulation),
    }
    cost = {name: median(t) for name, t in alternate(bodies, turns=turns, calls=PART_CALLS).items()}
    row("parts, each alone in a loop", "cpu p50", "of 1 ms with recording")
    rest = plain_us - sum(cost.values()) + cost[PLANT] + cost[SAMPLER]  # the emulator has the plant
    cost["rest of the cycle: Control, reference, loopback"] = rest
    cost["rest of recording: frame log, MCAP"] = recorded_us - plain_us - cost[SAMPLER]
    for name, value in cost.items():
        row(f"  {name}", us(value), f"{100 * value / recorded_us:.0f} %")


def capture_cycle(simulation: Simulation) -> tuple[list[bytes], list[bytes]]:
    """Return the TPDOs received and the frames sent in one cycle without heartbeats."""
    frames: list[tuple[int, bytes]] = []
    arm: ArmBus = simulation.control._bus  # type: ignore[assignment]
    arm.log_frames(lambda direction, frame: frames.append((direction, frame)))
    while len(frames) != 5:
        frames.clear()
        simulation.step()
    arm.log_frames(None)
    return [f for d, f in frames if d == RECEIVED], [f for d, f in frames if d == SENT]


def _plant(config: Config) -> Callable[[], object]:
    arm, tau_Nm = Arm(config.plant), (0.01, -0.005)

    def body() -> None:
        arm.step(tau_Nm, CURRENT_LOOP_S)
        arm.step(tau_Nm, CURRENT_LOOP_S)

    return body


def _emulator(config: Config, sent: list[bytes]) -> Callable[[], object]:
    """The emulator of a simulation of its own, taken off its bus: nobody receives its frames."""
    simulation = rig.tracking_simulation(config)
    emulator = simulation._emulator
    assert emulator is not None
    arm: ArmBus = simulation.control._bus  # type: ignore[assignment]
    loopback: LoopbackBus = arm._bus  # type: ignore[assignment]
    receive, drop = emulator.receive, loopback._queue.clear
    sync, command_1, command_2 = sent
    is_heartbeat_due = cycle([True] + [False] * 49)

    def body() -> None:
        if next(is_heartbeat_due):
            receive(arm._heartbeat)
        receive(sync)
        receive(command_1)
        receive(command_2)
        drop()

    return body


def _drivers(config: Config, received: list[bytes]) -> Callable[[], object]:
    """Axes of a simulation of their own, moved onto a bus that answers SYNC with two frames."""
    simulation = rig.tracking_simulation(config)
    arm: ArmBus = simulation.control._bus  # type: ignore[assignment]
    loopback: LoopbackBus = arm._bus  # type: ignore[assignment]
    sync, (first, second), deliver = arm._sync, received, loopback.deliver
    torques = [0.1, -0.05]

    def answer(frame: bytes) -> None:
        if frame is sync:
            deliver(first)
            deliver(second)

    loopback.connect(answer)

    def body() -> None:
        arm.request_feedback()
        arm.collect(0)
        arm.send_torques(torques)
        for axis in arm.axes:
            axis._heartbeat_age = 0  # type: ignore[attr-defined]

    return body


def _checks(config: Config) -> Callable[[], object]:
    settings = config.controller
    estimator = make_estimator(settings.velocity, config.joints)
    guard, limiter = MotionGuard(settings.limits), TorqueLimiter(settings.limits)
    poses = cycle([[0.1, 0.2], [0.1 + 1e-5, 0.2 - 1e-5]])
    torques = cycle([[0.5, -0.25], [0.52, -0.27]])

    def body() -> None:
        q = next(poses)
        dq = estimator.step(q, 1e-3)
        guard.check(q, dq, q)
        limiter.step(next(torques), 1e-3)

    return body


def _law(config: Config) -> Callable[[], object]:
    settings = config.controller
    law = PassivityLaw(settings.law, settings.limits.tau_max_Nm)
    setpoint = rig.setpoint([0.11, 0.19], [0.2, -0.1])
    return lambda: law.step([0.1, 0.2], [0.21, -0.1], setpoint, 1e-3)


def _sampler(simulation: Simulation) -> Callable[[], object]:
    layout = SampleLayout(simulation.config.joints, with_truth=True)
    control = simulation.control
    sampler = Sampler(layout, control, control._bus, simulation._truth)
    buffer = bytearray(layout.size)
    return lambda: sampler.write(buffer, 0, (1, 1_000_000, 0), NO_STAMPS)
