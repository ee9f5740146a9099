"""Conformance: clients that are not ours drive the emulated MIT-mode motors over the hub.

`damiao-motor` and `python-cybergear` run unmodified on the python-can plugin; in
`robstride-dynamics` and `mini-cheetah-motor-driver-socketcan` the Linux CAN socket, which they open
themselves, is replaced by one on the hub. Time is the wall clock; what is waited for is polled.
"""

import importlib
import socket
import tempfile
import threading
import time

import can
import pytest

from drivers.mit.codec import Ranges
from sim_backend.arm import Arm
from sim_backend.emulator import Emulator
from sim_backend.hub import UnixHub
from sim_backend.mit.node import make_node
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.server import EmulatorServer
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings

WAIT_S = 10.0


def client(name):
    """A client library; without it there is nothing to test."""
    return pytest.importorskip(name, reason=f"{name} is not installed (extra `dev`)")


class EmulatedArm:
    """Two motors and their arm behind a hub, by the wall clock, in a thread."""

    def __init__(self, path, variant, replies, ranges, **changes):
        self.hub = UnixHub(path)
        self.path = path
        self.servos = [Servo(settings) for settings in servo_preset("bench")]
        self.nodes = [
            make_node(
                MitNodeSettings(
                    variant=variant, node_id=number, reply_id=reply, ranges=ranges, **changes
                ),
                servo,
                self.hub.transmit,
            )
            for number, (servo, reply) in enumerate(zip(self.servos, replies, strict=True), start=1)
        ]
        emulator = Emulator(
            Arm(plant_preset("bench", (0.3, -0.4))), self.servos, self.nodes, is_lockstep=False
        )
        server = EmulatorServer(emulator, self.hub, EmulatorSettings(time="wall"))
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=server.run, args=(self._is_ended.is_set,))
        self._thread.start()

    def close(self):
        self._is_ended.set()
        self._thread.join()
        self.hub.close()


@pytest.fixture
def emulate():
    """Start emulated arms, gone when the test is over."""
    started = []
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:

        def start(variant, replies, ranges, **changes):
            path = f"{folder}/bus{len(started)}"
            started.append(EmulatedArm(path, variant, replies, ranges, **changes))
            return started[-1]

        yield start
        for arm in started:
            arm.close()


def wait_until(condition, act=lambda: None):
    """Act, and look whether a condition holds, until it does."""
    deadline_s = time.monotonic() + WAIT_S
    while True:
        act()
        value = condition()
        if value:
            return value
        assert time.monotonic() < deadline_s, "it did not come true"
        time.sleep(0.005)


# --- damiao-motor 1.0.6 ---------------------------------------------------------------------------


@pytest.fixture
def damiao(emulate):
    arm = emulate("damiao", (0x11, 0x12), Ranges(12.5, 30.0, 10.0))
    library = client("damiao_motor")
    controller = library.DaMiaoController(channel=arm.path, bustype="hil-unix")
    yield arm, controller
    controller.shutdown()


@pytest.mark.filterwarnings("ignore:The 'bustype' argument is deprecated:DeprecationWarning")
def test_damiao_motor__both_motors__registers_power_torque_and_state(damiao):
    arm, controller = damiao
    first, second = (
        controller.add_motor(number, 0x10 + number, motor_type="4310") for number in (1, 2)
    )
    first.ensure_control_mode("MIT")
    values = first.read_all_registers(timeout=5.0)
    assert [values[number] for number in (7, 8, 10, 21, 22, 23)] == [0x11, 1, 1, 12.5, 30.0, 10.0]
    assert not [value for value in values.values() if isinstance(value, str)], "unread registers"
    controller.enable_all()
    wait_until(lambda: arm.nodes[0].is_enabled and arm.nodes[1].is_enabled)

    def push():
        first.send_cmd_mit(feedforward_torque=1.5)
        second.send_cmd_mit(feedforward_torque=-0.5)

    def is_seen():
        state, other = first.get_states(), second.get_states()
        return (
            state.get("status") == other.get("status") == "ENABLED"
            and abs(state["torq"] - 1.5) < 0.05
            and abs(other["torq"] + 0.5) < 0.05
        )

    wait_until(is_seen, push)
    assert first.get_states()["can_id"] == 1
    before_rad = first.get_states()["pos"]
    wait_until(lambda: first.get_states()["pos"] > before_rad + 0.01, push)
    controller.disable_all()
    wait_until(lambda: not arm.nodes[0].is_enabled and not arm.nodes[1].is_enabled)


@pytest.mark.filterwarnings("ignore:The 'bustype' argument is deprecated:DeprecationWarning")
def test_damiao_motor__timeout_set__lost_communication_and_cleared(damiao):
    arm, controller = damiao
    motor = controller.add_motor(1, 0x11, motor_type="4310")
    motor.set_can_timeout(50)
    wait_until(lambda: arm.nodes[0].watchdog_s == pytest.approx(0.05))
    motor.enable()
    wait_until(lambda: arm.nodes[0].fault)
    assert not arm.servos[0].is_energised
    wait_until(
        lambda: motor.get_states().get("status") == "LOST_COMM", motor.request_motor_feedback
    )
    motor.clear_error()
    wait_until(lambda: motor.get_states().get("status") == "DISABLED")
    motor.enable()
    wait_until(lambda: motor.get_states().get("status") == "ENABLED")
    motor.disable()


# --- python-cybergear 0.1.2 -----------------------------------------------------------------------


def test_python_cybergear__found_by_scan__power_torque_parameters_and_faults(emulate):
    arm = emulate("cybergear", (0xFD, 0xFD), Ranges(12.5, 30.0, 12.0))
    library = client("cybergear.cybergear")
    bus = {"interface": "hil-unix", "channel": arm.path}
    scanned = library.CyberGearMotor.scan(bus_config=bus, timeout=1.0)
    assert scanned == [(1, b"HIL-WALL"), (2, b"HIL-WALL")]
    with library.CyberGearMotor(bus_config=bus, can_id=1, poll_interval=0.05) as motor:
        assert bytes.fromhex(motor.device_id) == b"HIL-WALL"
        wait_until(lambda: motor.v_bus == 24.0 and motor.run_mode == "operation")
        motor.limit_torque = 3.0
        wait_until(lambda: motor.limit_torque == 3.0)
        motor.enable()
        wait_until(lambda: motor.feedback.mode == 2)
        wait_until(
            lambda: abs(motor.feedback.torque - 1.0) < 0.05,
            lambda: motor.motor_control(1.0, 0.0, 0.0, 0.0, 0.0),
        )
        assert motor.feedback.temperature == 30.0
        assert not motor.feedback.faults.has_fault
        arm.nodes[0].fail(1 << 2)
        wait_until(
            lambda: motor.feedback.faults.over_temperature,
            lambda: motor.motor_control(1.0, 0.0, 0.0, 0.0, 0.0),
        )
        assert motor.feedback.mode == 0
    assert not arm.servos[0].is_energised


# --- robstride-dynamics 0.0.1 ---------------------------------------------------------------------


def test_robstride_dynamics__on_a_socket_of_the_hub__watchdog_power_torque(emulate):
    arm = emulate("robstride", (0xFF, 0xFF), Ranges(4 * 3.141592653589793, 44.0, 17.0))
    library = client("robstride_dynamics")
    kinds = importlib.import_module("robstride_dynamics.protocol").ParameterType
    motors = {
        name: library.Motor(id=number, model="rs-02") for number, name in ((1, "a"), (2, "b"))
    }
    bus = library.RobstrideBus("hub", motors)
    bus.channel_handler = can.Bus(interface="hil-unix", channel=arm.path)
    try:
        assert bus.read_id("a") == (1, bytearray(b"HIL-WALL"))
        assert bus.read("a", kinds.CAN_TIMEOUT) == 0, "off as it leaves the factory"
        bus.write("a", kinds.MODE, 0)
        bus.enable("a")
        assert arm.servos[0].is_energised
        bus.write_operation_frame("a", 0.0, 0.0, 0.0, torque=2.0)
        bus.read_operation_frame("a")

        def torque():
            bus.write_operation_frame("a", 0.0, 0.0, 0.0, torque=2.0)
            return bus.read_operation_frame("a")[2]

        wait_until(lambda: abs(torque() - 2.0) < 0.05)
        position = bus.read("a", kinds.MECHANICAL_POSITION)
        assert position == pytest.approx(arm.servos[0].q_rad, abs=0.5)
        bus.write("a", kinds.CAN_TIMEOUT, 1000)
        wait_until(lambda: not arm.servos[0].is_energised)
        bus.enable("b")
        bus.disable("b")
        assert not arm.servos[1].is_energised
    finally:
        bus.disconnect(disable_torque=False)


# --- mini-cheetah-motor-driver-socketcan 0.4.3 ----------------------------------------------------


def test_mini_cheetah_driver__on_a_socket_of_the_hub__power_zero_torque_position(
    emulate, monkeypatch
):
    # The library reads 14 bytes, a frame of 6: T-Motor. Its wait after zeroing is 1.5 s, burnt.
    arm = emulate("tmotor", (0, 0), Ranges(12.5, 76.0, 12.0))
    library = client("motor_driver.canmotorlib")
    monkeypatch.setattr(library, "set_zero_sleep", 0.1)
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as hub:
        hub.connect(arm.path)
        hub.settimeout(5.0)
        monkeypatch.setattr(library.CanMotorController, "can_socket_declared", True)
        monkeypatch.setattr(library.CanMotorController, "motor_socket", hub)
        motor = library.CanMotorController("hub", 1, "AK80_6_V2")
        q_rad, dq_rad_s, _ = motor.enable_motor()
        assert arm.nodes[0].is_enabled
        assert (q_rad, dq_rad_s) == pytest.approx((0.0, 0.0), abs=0.05)
        wait_until(lambda: abs(motor.send_rad_command(0, 0, 0, 0, 1.0)[2] - 1.0) < 0.05)
        wait_until(lambda: abs(motor.send_rad_command(0.5, 0, 20, 2, 0)[0] - 0.5) < 0.05)
        motor.disable_motor()
        assert not arm.nodes[0].is_enabled
