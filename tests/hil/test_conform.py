"""The conformance kit: a good node passes every step, each kind of bad one fails the right step.

The nodes are emulated ones on a real hub, served by a thread; the bad ones are spoilt on purpose.
"""

import json
import re
import signal
import tempfile
import threading
from contextlib import contextmanager
from dataclasses import replace
from itertools import count
from time import monotonic_ns

import can
import pytest

import hil.conform_bench
from drivers.arm_bus import ArmBus
from drivers.axis import AxisStatus
from drivers.bus import open_bus
from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State
from drivers.frame import pack_frame, unpack_frame
from drivers.registry import make_axes
from hil.cli import main
from hil.config import load_config
from hil.conform import Outcome, Step, run_steps
from hil.conform_bench import Bench, Limits, Timing
from hil.conform_steps import STEPS
from hil.emulation import build_emulator
from sim_backend.hub import UnixHub
from sim_backend.server import EmulatorServer
from tests.hil.lab import wait_until

STALL_S = 0.5
TPDO = codec.COB_TPDO1 + 1
NAMES = [step.name for step in STEPS]
LIMITS = Limits(torque_Nm=0.75, torque_max_Nm=1.5, watchdog_s=0.02, may_inject=True)


class Emulation:
    """An emulated arm served by a thread; `emulator` may be spoilt before it starts."""

    def __init__(self, path, spoil=None, change=None, **over):
        settings = {"stall_timeout_s": STALL_S, "time": "lockstep"}
        self.config = load_config(None, {"emulator": settings, **over})
        self.address = f"unix:{path}"
        self._hub = UnixHub(path)
        is_lockstep = self.config.emulator.time == "lockstep"
        self.emulator = build_emulator(self.config, self._send, is_lockstep=is_lockstep)
        self._change = change or (lambda frame: frame)
        self.node = self.emulator._nodes[0]
        if spoil is not None:
            spoil(self.node)
        server = EmulatorServer(self.emulator, self._hub, self.config.emulator)
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=server.run, args=(self._is_ended.is_set,))
        self._thread.start()

    def _send(self, frame):
        changed = self._change(frame)
        if changed is not None:
            self._hub.transmit(changed)

    def close(self):
        self._is_ended.set()
        self._thread.join()
        self._hub.close()


@contextmanager
def emulation(*arguments, **keywords):
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        running = Emulation(f"{folder}/bus", *arguments, **keywords)
        try:
            yield running
        finally:
            running.close()


TIMING = Timing(stall_timeout_s=STALL_S, heartbeat_cycles=100)


def run_kit(running, limits=LIMITS, steps=STEPS, timing=TIMING, **changes):
    """Run steps against the first joint; return {step: result}."""
    settings = running.config.axes[0].model_copy(
        update={"torque_max_Nm": limits.torque_max_Nm, **changes}
    )
    bus = ArmBus(
        open_bus(running.address), make_axes([settings], period_s=1e-3), now_ns=monotonic_ns
    )
    seen = []
    try:
        results = run_steps(Bench(bus, limits, timing), steps, seen.append)
    finally:
        bus.close()
    assert seen == results
    return {result.name: result for result in results}


def only(*names):
    """The steps needed to reach these, and these."""
    start = ("presence", "start-up", "feedback", "enable")
    return [step for step in STEPS if step.name in (*start, *names)]


def failed(results):
    return [name for name, result in results.items() if result.outcome is Outcome.FAIL]


# --- good nodes -----------------------------------------------------------------------------------


def test_kit__emulated_drive_in_lockstep__passes_every_step():
    with emulation() as running:
        results = run_kit(running)
        assert not running.node.drive.machine.is_powered
    assert {name: r.detail for name, r in results.items() if r.outcome is not Outcome.PASS} == {}
    assert list(results) == NAMES
    loss = results["loss of commands"]
    assert re.search(r"removed 2\d ms after its command", loss.detail)
    assert "EMCY 8250" in loss.detail


def test_kit__drive_with_its_own_clock__passes_every_step():
    """By the wall clock; a long watchdog, because this machine may stall."""
    axes = {"1": {"rpdo_timeout_ms": 150}}
    limits = Limits(torque_Nm=0.75, torque_max_Nm=1.5, watchdog_s=0.15, may_inject=True)
    settings = {"time": "wall"}
    with emulation(emulator=settings, axes=axes) as running:
        results = run_kit(running, limits)
    assert {name: r.detail for name, r in results.items() if r.outcome is not Outcome.PASS} == {}


def test_kit__torques_sent__never_above_the_limit_of_the_run():
    """Whatever a step asks for, what is on the wire is within `--limit`."""
    with emulation() as running:
        results = run_kit(running)
    torques = [
        codec.RPDO1.unpack(unpack_frame(frame)[1])[1]
        for result in results.values()
        for _, _, frame in result.frames
        if unpack_frame(frame)[0] == codec.COB_RPDO1 + 1
    ]
    rated_Nm = running.config.axes[0].rated_torque_Nm
    assert max(map(abs, torques)) == round(1000.0 * LIMITS.torque_max_Nm / rated_Nm)


def test_kit__clamped_joint_and_real_drive__steps_not_asked_say_why():
    limits = Limits(torque_Nm=0.75, torque_max_Nm=1.5, watchdog_s=0.02, is_clamped=True)
    with emulation() as running:
        results = run_kit(running, limits)
    not_asked = {n: r.detail for n, r in results.items() if r.outcome is Outcome.NOT_ASKED}
    assert not_asked == {
        "direction of motion": "the joint is clamped",
        "fault": "a real drive cannot be asked to fail",
        "fault holds": "the drive is not in fault",
        "reset after fault": "the drive is not in fault but ENABLED",
    }
    assert not failed(results)


def test_kit__drive_found_in_fault__is_told_and_reset():
    with emulation(spoil=lambda node: None) as running:
        running.node.drive.fail(0x5001)
        results = run_kit(running, steps=only("torque"))
    assert "begins in fault" in results["feedback"].detail
    assert not failed(results)


# --- bad nodes ------------------------------------------------------------------------------------


def changing_tpdo(change):
    """A wire on which the feedback of node 1 is changed: (status, position, torque) -> the same."""

    def changed(frame):
        can_id, data = unpack_frame(frame)
        if can_id != TPDO:
            return frame
        return pack_frame(TPDO, codec.TPDO1.pack(*change(*codec.TPDO1.unpack(data))))

    return changed


def test_kit__torque_reported_with_the_wrong_sign__told_so():
    with emulation(change=changing_tpdo(lambda s, p, t: (s, p, -t))) as running:
        results = run_kit(running, steps=only("torque"))
    assert failed(results) == ["torque"]
    assert "the sign is wrong; check axes.N.direction" in results["torque"].detail


def test_kit__torque_reported_too_large__both_values_told():
    change = changing_tpdo(lambda s, p, t: (s, p, round(1.3 * t)))
    with emulation(change=change) as running:
        results = run_kit(running, steps=only("torque", "torque limit"))
    assert failed(results) == ["torque", "torque limit"]
    assert "+0.188 Nm commanded, +0.245 Nm reported" in results["torque"].detail


def test_kit__angle_against_torque__direction_fails():
    change = changing_tpdo(lambda s, p, t: (s, (-p) % 4096, t))
    with emulation(change=change) as running:
        results = run_kit(running, steps=only("torque", "direction of motion"))
    assert failed(results) == ["direction of motion"]
    assert "the angle counts against the torque" in results["direction of motion"].detail


def test_kit__joint_that_does_not_move__direction_fails_with_the_remedy():
    with emulation(change=changing_tpdo(lambda s, p, t: (s, 0, t))) as running:
        results = run_kit(running, steps=only("direction of motion"))
    assert failed(results) == ["direction of motion"]
    assert "raise --torque, or say --clamped" in results["direction of motion"].detail


def without_watchdog(node):
    node._lose_connection = lambda *_: None


def test_kit__drive_without_watchdog__both_losses_fail_and_torque_is_off_at_the_end():
    with emulation(without_watchdog) as running:
        results = run_kit(running, steps=only("loss of commands", "loss of master"))
        assert running.node.drive.machine.state is Cia402State.SWITCH_ON_DISABLED
        assert not running.node.servo.is_energised
    assert failed(results) == ["loss of commands", "loss of master"]
    assert "still enabled 40 ms after the last command" in results["loss of commands"].detail


def test_kit__drive_slower_than_its_watchdog__fails():
    with emulation() as running:
        results = run_kit(running, steps=only("loss of commands"), rpdo_timeout_ms=60)
    assert failed(results) == ["loss of commands"]


def enabling_itself(node):
    """Back in operation as soon as SYNC comes after a fault."""
    lose, control = node._lose_connection, node.drive.control

    def stays(code, *rest):
        lose(code, *rest)
        node.is_wild = True

    def obeys(controlword):
        control(controlword)
        if getattr(node, "is_wild", False):
            node.drive.machine.state = Cia402State.OPERATION_ENABLED
            node.drive._follow_state()

    node._lose_connection = stays
    node.dictionary.bind(codec.Index.CONTROLWORD, read=lambda: 0, write=obeys)
    for rpdo in node._rpdos:
        rpdo.compile()


def test_kit__drive_that_enables_itself__fails_to_stay_off():
    with emulation(enabling_itself) as running:
        results = run_kit(running, steps=only("loss of commands", "off after loss of commands"))
    assert failed(results) == ["off after loss of commands"]
    assert "enabled itself" in results["off after loss of commands"].detail


def test_kit__fault_that_cannot_be_reset__reset_and_what_needs_it_fail():
    names = ("fault", "fault holds", "reset after fault", "torque after fault")
    with emulation() as running:
        machine = type(running.node.drive.machine)
        before = machine.command

        def deaf(self, controlword):
            if not self.is_faulted:
                before(self, controlword)

        machine.command = deaf
        try:
            results = run_kit(running, steps=only(*names))
        finally:
            machine.command = before
    assert failed(results) == ["reset after fault", "torque after fault"]
    assert "the axis is FAULT" in results["reset after fault"].detail


def test_kit__nobody_there__presence_fails_and_nothing_else_is_asked():
    with emulation() as running:
        results = run_kit(running, node_id=9, sdo_timeout_s=0.05)
    assert failed(results) == ["presence"]
    assert "no SDO answer" in results["presence"].detail
    assert {results[name].outcome for name in NAMES[1:]} == {Outcome.NOT_REACHED}


def test_kit__scales_differ__start_up_fails_and_nothing_is_driven():
    with emulation() as running:
        results = run_kit(running, rated_torque_Nm=1.0)
        assert not running.node.drive.machine.is_powered
    assert failed(results) == ["start-up"]
    assert "rated torque 6076" in results["start-up"].detail
    sent = [frame for r in results.values() for _, way, frame in r.frames if way == 1]
    assert not [f for f in sent if unpack_frame(f)[0] == codec.COB_RPDO1 + 1]


def test_kit__torque_of_a_few_steps__start_up_fails_with_the_least():
    limits = Limits(torque_Nm=0.05, torque_max_Nm=1.5, watchdog_s=0.02)
    with emulation() as running:
        results = run_kit(running, limits)
        assert not running.node.drive.machine.is_powered
    assert failed(results) == ["start-up"]
    assert "use --torque 0.1 or more" in results["start-up"].detail


def test_kit__feedback_ends__torque_off_is_asked_for(monkeypatch):
    monkeypatch.setattr(hil.conform_bench, "MISSING_LIMIT", 2)  # each one missed costs a timeout
    lost = threading.Event()

    def dying(frame):
        return None if lost.is_set() and unpack_frame(frame)[0] == TPDO else frame

    def cut(bench):
        lost.set()
        for _ in range(200):
            bench.cycle(0.1)
        return "never"

    steps = [*only(), Step("cut", cut, begins=AxisStatus.ENABLED)]
    timing = replace(TIMING, lockstep_timeout_s=0.3)
    with emulation(change=dying) as running:
        results = run_kit(running, steps=steps, timing=timing)
        assert not running.node.drive.machine.is_powered
    assert failed(results) == ["cut"]
    assert "no feedback for 2 cycles" in results["cut"].detail


def test_kit__joint_that_falls__torque_off_beyond_the_travel_allowed():
    """Released from a horizontal pose the arm falls as soon as it is enabled."""
    over = {"arm": {"preset": "pelican_v"}, "plant": {"q0_rad": [1.5, 0.0]}}
    limits = Limits(torque_Nm=1.5, torque_max_Nm=3.0, travel_rad=0.02, watchdog_s=0.02)
    with emulation(**over) as running:
        results = run_kit(running, limits, steps=only("torque"))
        assert not running.node.drive.machine.is_powered
    assert failed(results) == ["enable"]
    assert "more than the 0.02 rad allowed: torque off" in results["enable"].detail


def test_kit__joint_that_spins__is_not_enabled():
    angles = count(step=10)
    with emulation(change=changing_tpdo(lambda s, p, t: (s, next(angles) % 4096, t))) as running:
        results = run_kit(running, replace(LIMITS, travel_rad=10.0), steps=only("torque"))
        assert running.node.drive.machine.state is Cia402State.SWITCH_ON_DISABLED
    assert failed(results) == ["enable"]
    assert "does not come to rest within 3 s without torque" in results["enable"].detail


# --- the command ----------------------------------------------------------------------------------


def conform(capsys, *arguments):
    status = main(["conform", *arguments])
    output = capsys.readouterr()
    return status, output.out, output.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["stepper"], "family 'stepper' is not one of: cia402"),
        (["cia402", "--joint", "7"], "joint 7 of the configuration is cia402"),
        (["cia402", "--torque", "100"], "--torque 100 <= --limit 200 <= 15 Nm"),
        (["cia402", "--torque", "1", "--limit", "0.5"], "--torque 1 <= --limit 0.5"),
        (["cia402", "--travel", "0"], "--travel 0 must be more than 0"),
        (["cia402", "--bus", "can0"], "joint 1 on can0 will be driven with up to 1.5 Nm"),
        (["cia402", "--bus", "unix:/no/such"], "no bus at unix:/no/such"),
    ],
)  # fmt: skip
def test_conform__asked_for_the_impossible__one_line_and_status_1(capsys, arguments, words):
    status, _, err = conform(capsys, *arguments)
    assert status == 1
    assert err.startswith("hil: ")
    assert words in err
    assert len(err.splitlines()) == 1


def test_conform__unconfirmed_hardware__says_what_to_mind(capsys):
    _, _, err = conform(capsys, "cia402", "--bus", "can0")
    assert "emergency stop in hand; if that is so, add --yes" in err


@pytest.fixture(scope="module")
def running():
    with emulation() as running:
        yield running


@pytest.mark.parametrize("family", ["mit", "moteus", "odrive"])
def test_conform__every_other_family__passes_what_it_can_be_asked(capsys, family):
    with emulation(axes={"1": {"family": family}}) as running:
        status, out, _ = conform(
            capsys, family, "--bus", running.address,
            "--set", f"emulator.stall_timeout_s={STALL_S}",
        )  # fmt: skip
        assert not running.node.servo.is_energised
    assert status == 0, out
    assert "18 pass, 0 warn, 0 fail, 3 not asked, 0 not reached" in out
    assert "not asked    loss of commands " in out
    assert "pass         loss of master " in out


@pytest.mark.parametrize("variant", ["tmotor", "cubemars"])
def test_conform__family_without_a_watchdog__warned_of_and_never_passed(capsys, variant):
    """The protocol has none: that torque stays on is neither the node's fault nor good."""
    axis = {"family": "mit", "variant": variant, "is_lockstep": True, "master_id": 66}
    changes = [f"axes.1.{name}={value}" for name, value in axis.items() if name != "family"]
    arguments = [word for change in changes for word in ("--set", change)]
    with emulation(axes={"1": axis}) as running:
        status, out, _ = conform(
            capsys, "mit", "--bus", running.address, *arguments,
            "--set", f"emulator.stall_timeout_s={STALL_S}",
        )  # fmt: skip
        assert not running.node.servo.is_energised
    assert "WARN         loss of master " in out
    assert "torque stays when the master dies; use a power relay" in out
    assert ", 1 warn, 0 fail, " in out
    assert status == 0, out


def test_conform__watchdog_claimed_for_such_a_family__its_absence_is_a_failure(capsys):
    """`--watchdog` says that the vendor's tool has set one: then it has to act."""
    axis = {"family": "mit", "variant": "tmotor", "is_lockstep": True, "master_id": 66}
    with emulation(axes={"1": axis}) as running:
        status, out, _ = conform(
            capsys, "mit", "--bus", running.address, "--watchdog", "0.02",
            "--set", "axes.1.variant=tmotor", "--set", "axes.1.is_lockstep=true",
            "--set", "axes.1.master_id=66",
            "--set", f"emulator.stall_timeout_s={STALL_S}",
        )  # fmt: skip
    assert "FAIL         loss of master " in out
    assert status == 1


def test_conform__as_a_process__steps_frames_log_and_status_0(running, tmp_path, lab):
    log = tmp_path / "run.asc"
    process = lab.start(
        "conform", "cia402", "--bus", running.address, "--frames", "--log", str(log),
        "--set", f"emulator.stall_timeout_s={STALL_S}",
    )  # fmt: skip
    assert process.wait() == 0, process.stdout + process.stderr
    for name in NAMES:
        assert f"pass         {name} " in process.stdout
    assert "21 pass, 0 warn, 0 fail, 0 not asked, 0 not reached" in process.stdout
    assert "-> 000#8201" in process.stdout
    assert "J1_TPDO1 State='operation enabled'" in process.stdout
    with can.LogReader(log) as reader:
        identifiers = {message.arbitration_id for message in reader}
    assert {0x000, 0x080, TPDO, codec.COB_RPDO1 + 1} <= identifiers


def test_conform__json__machine_readable(running, lab):
    process = lab.start(
        "conform", "cia402", "--joint", "2", "--bus", running.address, "--json",
        "--set", f"emulator.stall_timeout_s={STALL_S}",
    )  # fmt: skip
    assert process.wait() == 0, process.stdout + process.stderr
    found = json.loads(process.stdout)
    assert found["ok"]
    assert [step["step"] for step in found["steps"]] == NAMES


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_conform__interrupted__torque_is_off(running, number, lab):
    """While the drive is under power: it is disabled before the process ends."""
    process = lab.start(
        "conform", "cia402", "--bus", running.address,
        "--set", "emulator.stall_timeout_s=5",
    )  # fmt: skip
    wait_until(lambda: "pass         enable " in process.stdout, what="the enabled drive")
    process.end(number)
    assert process.process.returncode == 130
    assert not running.node.drive.machine.is_powered
