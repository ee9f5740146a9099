"""Whole arms of MIT-mode motors: the reference scenario in virtual time, and a daemon on a bus."""

import pytest

from controller.machine import State
from drivers.mit import codec
from hil.config import load_config
from hil.emulation import build_emulator
from hil.simulation import Simulation
from tests.hil.lab import HilProcess, Lab, whole
from tests.hil.virtual import configured

MIT = ("axes.1.family=mit", "axes.2.family=mit")


def of_variant(variant):
    """Settings that make both joints of one variant."""
    settings = [*MIT, f"axes.1.variant={variant}", f"axes.2.variant={variant}"]
    if variant in ("tmotor", "cubemars"):
        settings += ["axes.1.is_lockstep=true", "axes.2.is_lockstep=true"]
    return settings


def options(assignments):
    return [word for assignment in assignments for word in ("--set", assignment)]


@pytest.fixture
def hil(tmp_path):
    """Start `hil` commands, each in a directory of its own."""
    started = []

    def start(*arguments, **environment):
        directory = tmp_path / str(len(started))
        directory.mkdir()
        started.append(HilProcess(directory, *arguments, **environment))
        return started[-1]

    yield start
    for process in started:
        process.close()


def test_sim__scenario_A_on_two_damiao_motors__every_bound_met_and_same_bytes_twice(hil):
    runs = [
        hil("sim", "--scenario", "A", *options(MIT), "--record", "a.mcap", PYTHONHASHSEED=seed)
        for seed in ("0", "4242")
    ]
    assert [run.wait(100) for run in runs] == [0, 0], runs[0].stdout + runs[0].stderr
    first, second = ((run.directory / "a.mcap").read_bytes() for run in runs)
    assert first == second


@pytest.mark.parametrize("variant", ["tmotor", "cubemars", "cybergear", "robstride"])
def test_simulation__other_variants__enabled_held_and_switched_off(variant):
    hold_still(of_variant(variant))


@pytest.mark.parametrize("variant", ["damiao", "robstride"])
def test_simulation__joint_1_cia402_joint_2_mit__enabled_held_and_switched_off(variant):
    hold_still(["axes.2.family=mit", f"axes.2.variant={variant}"])


def hold_still(assignments):
    simulation = Simulation(configured(*assignments))
    simulation.run(5)
    simulation.execute("enable")
    simulation.run_until(State.READY, 100)
    simulation.run(300)
    assert simulation.control.machine.state is State.READY
    held = simulation.control.player.setpoint.q_rad
    truth = simulation._plant.q_true_rad
    assert truth == pytest.approx(held, abs=0.01)
    simulation.execute("disable")
    simulation.run_until(State.IDLE, 1000)
    simulation.run(2)
    assert not any(servo.is_energised for servo in simulation._emulator._servos)


def test_config__mit_joint__ranges_reach_the_emulated_motor(tmp_path):
    file = tmp_path / "arm.toml"
    file.write_text(
        '[axes.2]\nfamily = "mit"\ntorque_range_Nm = 28\nvelocity_range_rad_s = 10\n'
        "watchdog_ms = 30\n"
    )
    config = load_config(str(file))
    node = build_emulator(config, lambda frame: None, is_lockstep=False)._nodes[1]
    assert node.ranges == codec.Ranges(12.5, 10.0, 28.0)
    assert node.torque_limit_Nm == 8.0, "the emulated motor has no more"


def test_daemon__mixed_arm_on_the_unix_bus__enabled_moves_and_its_motor_is_switched_off(tmp_path):
    lab = Lab(tmp_path)
    mixed = ("axes.2.family=mit",)
    try:
        lab.emulate(*mixed)
        watcher = lab.watch_bus()
        arm = lab.run(*mixed)
        arm.make_ready()
        arm.client.command("trajectory", kind="move", target_rad=[0.3, -0.3])
        arm.wait_for(State.ACTIVE)
        arm.wait_for(State.HOLD)
        assert arm.now["q_meas_rad"].tolist() == pytest.approx([0.3, -0.3], abs=0.1)
        arm.client.command("disable")
        arm.wait_for(State.IDLE)
        arm.catch_up()
        sent = [frame.data for frame in watcher.with_id(0x002)]
        assert codec.ENABLE in sent
        assert sent[-1] == codec.DISABLE
        assert len(watcher.with_id(0x012)) > 100
        assert arm.daemon.end() == 0
        assert len(whole(arm.recording).samples) > 500
    finally:
        lab.close()
