"""One experiment from enabling to rest: its trajectory request, and its run in virtual time."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from controller.machine import State
from controller.reference import MotionLimits, MotionState
from hil.config import Config
from hil.messages import KellyRequest, TrajectoryRequest
from hil.planner import plan
from hil.scenarios import Scenario
from hil.simulation import Simulation, SimulationError, open_recording

SETTLE_CYCLES = 100
"""Cycles recorded after the end of the trajectory."""
STOP_CYCLES = 5000


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


def run_in_simulation(
    config: Config,
    request: TrajectoryRequest,
    path: Path,
    progress: Callable[[float], object] | None = None,
) -> float:
    """Enable, play one trajectory to its end, disable; record everything.

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
    with open_recording(config, path) as recording:
        simulation = Simulation(config, recording)
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
            raise SimulationError(
                f"the arm went into {machine.state.name} ({machine.fault.name}); see {path}"
            )
        simulation.execute("disable")
        simulation.run_until(State.IDLE, STOP_CYCLES)
        simulation.close()
        return simulation.cycle * period_s
