"""One experiment from enabling to rest: its trajectory request, and its run in virtual time."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from controller.machine import State
from controller.reference import MotionLimits, MotionState
from hil.config import Config
from hil.fixed_protobuf import Records
from hil.messages import KellyRequest, SinusoidRequest, TrajectoryRequest
from hil.planner import plan
from hil.scenarios import Scenario
from hil.simulation import Simulation, SimulationError, Sink, open_recording
from hil.telemetry import SampleLayout

SCENARIO_JOINTS = 2
"""The reference scenarios are of arms with so many joints."""
SWING_S, SWING_RAD, SWING_HZ = 10.0, 0.3, 0.25
SETTLE_CYCLES = 100
"""Cycles recorded after the end of the trajectory."""
STOP_MARGIN_CYCLES = 100
"""Cycles beyond those that a damped stop may take until the arm must be idle."""


def scenario_request(scenario: Scenario) -> TrajectoryRequest:
    """Return the trajectory a reference scenario sends; it starts with an error on purpose."""
    return KellyRequest(
        duration_s=scenario.duration_s, rate=scenario.trajectory.rate, approach="none"
    )


def scenario_settings(scenario: Scenario) -> dict[str, Any]:
    """Return the settings a reference scenario stands for, to be laid over the configuration."""
    source = scenario.velocity
    is_ideal = source.kind == "true"
    velocity: dict[str, Any] = {"estimator": "amplifier" if is_ideal else source.kind}
    velocity["cutoff_Hz"] = source.cutoff_Hz
    velocity["C_rad_s2"] = source.levant_C_rad_s2
    return {
        "scenario": scenario.name,
        "arm": {"preset": scenario.preset},
        "plant": {"q0_rad": scenario.q0_rad},
        "controller": {"law": {"adaptation": scenario.adaptation}, "velocity": velocity},
        "emulator": {"is_ideal": is_ideal},
    }


def swing(config: Config) -> TrajectoryRequest:
    """Return a slow sinusoid of all joints about the start pose, for arms of any size."""
    n = config.joints
    return SinusoidRequest(
        duration_s=SWING_S,
        center_rad=config.plant.q0_rad,
        amplitude_rad=(SWING_RAD,) * n,
        frequency_Hz=(SWING_HZ,) * n,
        ramp_s=1.0,
    )


class Memory:
    """Keeps the samples of a run in memory; frames and events are let go."""

    def __init__(self, joints: int) -> None:
        self._layout = SampleLayout(joints, with_truth=True)
        self._payloads: list[bytes] = []

    def add_sample(self, t_ns: int, seq: int, payload: bytes) -> None:
        """Keep one sample."""
        del t_ns, seq
        self._payloads.append(payload)

    def add_bus_log(self, t_ns: int, payload: bytes) -> None:
        """Let frames go."""

    def add_trajectory(self, t_ns: int, crc: int, rows: bytes) -> None:
        """Let a reference go."""

    def add_event(
        self, t_ns: int, cycle: int, kind: str, detail: Mapping[str, Any] | str = "{}"
    ) -> None:
        """Let an event go."""

    def samples(self) -> Records:
        """Return all samples, one row a cycle."""
        return self._layout.decode(self._payloads)


def run_in_simulation(
    config: Config,
    request: TrajectoryRequest,
    path: Path,
    progress: Callable[[float], object] | None = None,
) -> float:
    """Enable, play one trajectory to its end, disable; record everything in a file.

    Args:
        config: The configuration.
        request: The trajectory, planned from the pose at which the arm stands.
        path: Recording to write.
        progress: Told how many seconds have been simulated since it was told last.

    Returns:
        The simulated time in seconds.

    Raises:
        Refusal: If the trajectory does not fit the arm.
        SimulationError: If the arm tripped; the recording shows how.
    """
    try:
        with open_recording(config, path) as recording:
            return play_in_simulation(config, request, recording, progress)
    except SimulationError as error:
        raise SimulationError(f"{error}; see {path}") from error


def play_in_simulation(
    config: Config,
    request: TrajectoryRequest,
    sink: Sink,
    progress: Callable[[float], object] | None = None,
) -> float:
    """As `run_in_simulation`, into any sink."""
    simulation = play_trajectory(config, request, sink, progress)
    period_s = config.loop.period_s
    simulation.execute("disable")
    stop_cycles = round(config.controller.stop_time_s / period_s)
    simulation.run_until(State.IDLE, stop_cycles + STOP_MARGIN_CYCLES)
    simulation.close()
    return simulation.cycle * period_s


def play_trajectory(
    config: Config,
    request: TrajectoryRequest,
    sink: Sink,
    progress: Callable[[float], object] | None = None,
) -> Simulation:
    """As `play_in_simulation` up to the end of the trajectory; the arm is still under power.

    Raises:
        Refusal: If the trajectory does not fit the arm.
        SimulationError: If the arm tripped.
    """
    simulation = Simulation(config, sink)
    simulation.execute("enable")
    simulation.run_until(State.READY, 1000)
    start = MotionState.at_rest(simulation.control.player.setpoint.q_rad)
    period_s = config.loop.period_s
    limits = MotionLimits.of(config.controller.limits, config.trajectory.max_duration_s)
    reference = plan(request, start, limits, period_s)
    simulation.play(reference)
    second = round(1.0 / period_s)
    cycles = reference.samples + SETTLE_CYCLES
    for done in range(0, cycles, second):
        simulation.run(min(second, cycles - done))
        if progress is not None:
            progress(min(second, cycles - done) * period_s)
    machine = simulation.control.machine
    if not machine.state.is_powered:
        simulation.close()
        raise SimulationError(f"the arm went into {machine.state.name} ({machine.fault.name})")
    return simulation
