"""What several benchmarks run on: configurations, the emulator process, a simulated arm."""

import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from controller.machine import State
from controller.player import Setpoint
from controller.reference import MotionLimits, MotionState, Reference
from hil.config import Config, load_config, merge
from hil.experiment import scenario_request, scenario_settings
from hil.planner import plan
from hil.recording import RecordingWriter
from hil.scenarios import find_scenario
from hil.simulation import Simulation
from sim_backend.presets import plant_preset
from sim_backend.settings import PlantSettings

SCENARIO = "A"
START_TIMEOUT_S = 20.0


def configuration(bus: str | None = None, **over: object) -> Config:
    """Return scenario A's configuration, on a bus of its own if one is given."""
    settings = merge(scenario_settings(find_scenario(SCENARIO)), over)
    if bus is not None:
        settings = merge(settings, {"bus": {"address": bus}})
    return load_config(None, settings)


def reference(config: Config, q_rad: list[float]) -> Reference:
    """Compile scenario A's trajectory, approached smoothly, from a pose at rest."""
    limits = MotionLimits.of(config.controller.limits, config.trajectory.max_duration_s)
    scenario = scenario_request(find_scenario(SCENARIO))
    request = scenario.model_copy(update={"approach": "blend"})
    return plan(request, MotionState.at_rest(q_rad), limits, config.loop.period_s)


def setpoint(q_rad: list[float], dq_rad_s: list[float]) -> Setpoint:
    """Return a reference without acceleration."""
    return Setpoint(q_rad, dq_rad_s, [0.0] * len(q_rad))


def tracking_simulation(config: Config, recording: RecordingWriter | None = None) -> Simulation:
    """Return a simulation that has just begun to track scenario A."""
    simulation = Simulation(config, recording)
    simulation.execute("enable")
    simulation.run_until(State.READY, 1000)
    simulation.play(reference(config, simulation.control.player.setpoint.q_rad))
    return simulation


def chain(links: int, substep_s: float) -> PlantSettings:
    """Return a horizontal chain made of the bench arm's links, the outer ones lighter."""
    bench = plant_preset("bench_h")
    rows = []
    for number in range(links):
        link = bench.links[min(number, 1)]
        share = 0.7 ** max(0, number - 1)
        lighter = {
            "mass_kg": link.mass_kg * share,
            "inertia_kg_m2": link.inertia_kg_m2 * share,
            "viscous_Nms_rad": link.viscous_Nms_rad * share,
            "coulomb_Nm": link.coulomb_Nm * share,
        }
        rows.append(link.model_copy(update=lighter))
    pose = tuple(0.3 if number % 2 else -0.2 for number in range(links))
    update = {
        "links": tuple(rows),
        "q0_rad": pose,
        "substep_s": substep_s,
        "is_held_until_enabled": False,
    }
    return bench.model_copy(update=update)


@contextmanager
def emulator_process(*, realtime: str = "best_effort") -> Iterator[str]:
    """Run `hil emulate` in lockstep on a unix bus of its own; yields the bus's address."""
    with tempfile.TemporaryDirectory(prefix="hil-bench-") as scratch:
        address = f"unix:{scratch}/bus.sock"
        arguments = ["--scenario", SCENARIO, "--bus", address, "--time", "lockstep"]
        arguments += ["--set", f"loop.realtime={realtime}"]
        process = subprocess.Popen(
            [sys.executable, "-m", "hil", "emulate", *arguments], stdout=subprocess.PIPE, text=True
        )
        assert process.stdout is not None
        try:
            if not process.stdout.readline():
                raise RuntimeError("hil emulate did not start")
            yield address
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(START_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            process.stdout.close()


@contextmanager
def scheduled_as_loop(priority: int) -> Iterator[str]:
    """Run at the loop's real-time priority where it is granted; yields the scheduler's name."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError:
        yield "SCHED_OTHER"
        return
    try:
        yield "SCHED_FIFO"
    finally:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


@contextmanager
def scratch_file(name: str) -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="hil-bench-") as directory:
        yield Path(directory) / name
