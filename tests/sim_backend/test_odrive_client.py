"""Conformance: `odrive-can`, which is not ours, drives the emulated axes over the hub, unmodified.

Everything is real: the Unix socket, the python-can plugin, the emulator with its arm by the wall
clock, the DBC that comes with the client. Then the flows of the vendor's own example programs
(ODriveResources: can_enumerate.py, can_simple.py, can_param_access.py), in python-can alone.
"""

import asyncio
import math
import struct
import tempfile
import threading
import time

import can
import pytest
from odrive_can.odrive import DriveError, ODriveCAN

from drivers.can_plugin import HilUnixBus
from drivers.odrive.endpoints import EMULATED, Endpoint
from sim_backend.arm import Arm
from sim_backend.emulator import Emulator
from sim_backend.hub import UnixHub
from sim_backend.odrive.node import OdriveNode, OdriveNodeSettings
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.server import EmulatorServer
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings

WAIT_S = 5.0
BROADCAST = 0x3F


class EmulatedArm:
    """Two axes, nodes 0 and 1, and their arm behind a hub, by the wall clock, in a thread."""

    def __init__(self, path):
        hub = UnixHub(path)
        self.path = path
        self.servos = [Servo(settings) for settings in servo_preset("bench")]
        self.nodes = [
            OdriveNode(node_id, servo, hub.transmit, OdriveNodeSettings(gear_ratio=2.0))
            for node_id, servo in enumerate(self.servos)
        ]
        emulator = Emulator(Arm(plant_preset("bench")), self.servos, self.nodes, is_lockstep=False)
        server = EmulatorServer(emulator, hub, EmulatorSettings(time="wall"))
        self._hub = hub
        self._is_ended = threading.Event()
        self._thread = threading.Thread(target=server.run, args=(self._is_ended.is_set,))
        self._thread.start()

    def close(self):
        self._is_ended.set()
        self._thread.join()
        self._hub.close()


@pytest.fixture
def arm():
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        arm = EmulatedArm(f"{folder}/bus")
        yield arm
        arm.close()


def with_client(arm, axis_id, actions):
    """Run `actions(client)` while odrive-can is connected to an axis."""

    async def run():
        client = ODriveCAN(axis_id, can_bus=HilUnixBus(arm.path))
        await asyncio.wait_for(client.start(), WAIT_S)
        try:
            await actions(client)
        finally:
            client.stop()

    asyncio.run(run())


async def until(condition):
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not happen"
        await asyncio.sleep(0.005)


async def enable_torque(client):
    client.clear_errors()
    client.set_controller_mode("TORQUE_CONTROL", "PASSTHROUGH")
    client.set_input_torque(0.0)
    await client.set_axis_state("CLOSED_LOOP_CONTROL")
    client.check_errors()


@pytest.mark.parametrize("axis_id", [0, 1])
def test_odrive_can__torque_control__closed_loop_iq_and_motion(arm, axis_id):
    servo = arm.servos[axis_id]

    async def actions(client):
        await enable_torque(client)
        client.set_input_torque(0.25)
        await until(lambda: servo.current_A * servo.settings.torque_constant_Nm_A > 0.45)
        iq = await client.get_iq()
        wanted_A = 0.5 / servo.settings.torque_constant_Nm_A
        assert iq["Iq_Setpoint"] == pytest.approx(wanted_A, rel=1e-3)
        assert iq["Iq_Measured"] == pytest.approx(wanted_A, rel=0.1)
        await until(lambda: servo.q_rad > 0.1)
        client.set_input_torque(0.0)
        estimates = await client.get_encoder_estimates()
        assert estimates["Vel_Estimate"] > 0.0
        turns = 2.0 * servo.q_rad / math.tau
        assert estimates["Pos_Estimate"] == pytest.approx(turns, abs=0.2)
        await client.set_axis_state("IDLE")
        assert not servo.is_energised

    with_client(arm, axis_id, actions)


def test_odrive_can__reads__voltage_and_encoder(arm):
    async def actions(client):
        bus = await client.get_bus_voltage_current()
        assert bus["Bus_Voltage"] == pytest.approx(48.0)
        estimates = await client.get_encoder_estimates()
        assert estimates == {"Pos_Estimate": 0.0, "Vel_Estimate": 0.0}

    with_client(arm, 0, actions)


def test_odrive_can__cyclic_encoder__its_callback_runs(arm):
    seen = []

    async def actions(client):
        client.feedback_callback = lambda message, _: seen.append(message.data["Pos_Estimate"])
        await until(lambda: len(seen) >= 20)

    with_client(arm, 0, actions)
    assert set(seen) == {0.0}


def test_odrive_can__velocity_control__turns_at_the_velocity_asked_for(arm):
    async def actions(client):
        client.set_controller_mode("VELOCITY_CONTROL", "PASSTHROUGH")
        client.set_vel_gains(2.0, 20.0)
        client.set_input_vel(0.25)
        await client.set_axis_state("CLOSED_LOOP_CONTROL")
        await until(lambda: arm.servos[1].q_rad > 0.4)
        assert arm.servos[1].dq_rad_s == pytest.approx(0.25 * math.tau / 2.0, rel=0.3)

    with_client(arm, 1, actions)


def test_odrive_can__watchdog_expires__error_by_name_and_cleared(arm):
    """As the client's own watchdog example: set-points pause, the error is seen and cleared."""

    async def actions(client):
        node = arm.nodes[0]
        node.axis.watchdog_timeout_s, node.axis.is_watchdog_on = 0.3, True
        await enable_torque(client)
        for _ in range(20):
            client.set_input_torque(0.05)
            await asyncio.sleep(0.02)
        client.check_errors()
        await until(lambda: not arm.servos[0].is_energised)
        await client.wait_for_heartbeat()
        with pytest.raises(DriveError, match="WATCHDOG_TIMER_EXPIRED"):
            client.check_errors()
        assert client.axis_state == "IDLE"
        client.clear_errors()
        await client.wait_for_heartbeat()
        client.check_errors()

    with_client(arm, 0, actions)


# --- the vendor's examples, frame by frame ------------------------------------------------------


class Flow:
    """python-can as the vendor's programs use it."""

    def __init__(self, path):
        self.bus = can.Bus(interface="hil-unix", channel=path)

    def send(self, node, command, data=b"", *, is_remote=False):
        self.bus.send(
            can.Message(
                arbitration_id=node << 5 | command,
                data=None if is_remote else data,
                is_remote_frame=is_remote,
                is_extended_id=False,
            )
        )

    def wait(self, node, command):
        deadline_s = time.monotonic() + WAIT_S
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            message = self.bus.recv(left_s)
            if message is not None and message.arbitration_id == node << 5 | command:
                return bytes(message.data)
        raise AssertionError(f"no 0x{command:02X} of node {node}")

    def wait_for_state(self, node, wanted):
        for _ in range(20):
            error, state, _, _ = struct.unpack("<IBBB", self.wait(node, 0x01)[:7])
            if (error, state) == (0, wanted):
                return
        raise AssertionError(f"state {state}, error {error:08X}")

    def scan(self, count):
        """Serial number -> node, of so many drives, as can_enumerate.py asks for them."""
        self.send(BROADCAST, 0x06, is_remote=True)
        found = {}
        deadline_s = time.monotonic() + WAIT_S
        while len(found) < count:
            assert time.monotonic() < deadline_s, found
            message = self.bus.recv(0.1)
            if message is None or message.arbitration_id & 0x1F != 0x06:
                continue
            if not message.is_remote_frame and len(message.data) >= 7:
                found[int.from_bytes(message.data[1:7], "little")] = message.data[0]
        return found


@pytest.fixture
def flow(arm):
    flow = Flow(arm.path)
    yield flow
    flow.bus.shutdown()


def test_can_enumerate__scan_assign_and_identify__nodes_by_serial_number(arm, flow):
    serials = [node.serial for node in arm.nodes]
    assert flow.scan(2) == {serials[0]: 0, serials[1]: 1}
    flow.send(BROADCAST, 0x06, bytes([1]) + serials[0].to_bytes(6, "little"))
    assert flow.wait(1, 0x06)[0] == 1  # drive 0 took it; drive 1 leaves it:
    assert flow.wait(BROADCAST, 0x06)[0] == BROADCAST
    assert flow.scan(2) == {serials[0]: 1, serials[1]: BROADCAST}
    flow.send(BROADCAST, 0x06, bytes([5]) + serials[1].to_bytes(6, "little"))
    assert flow.wait(5, 0x06)[0] == 5
    flow.send(BROADCAST, 0x18, b"\x00")
    flow.send(5, 0x18, b"\x01")
    flow.send(5, 0x16, b"\x01")
    assert flow.scan(2) == {serials[0]: 1, serials[1]: 5}


def test_can_simple__closed_loop_then_set_points__feedback_arrives(arm, flow):
    flow.wait_for_state(1, 1)  # it has been switched on just now
    flow.send(1, 0x0B, struct.pack("<II", 2, 1))
    flow.send(1, 0x07, struct.pack("<I", 8))
    flow.wait_for_state(1, 8)
    for _ in range(5):
        flow.send(1, 0x0D, struct.pack("<ff", 0.5, 0.0))
        position, velocity = struct.unpack("<ff", flow.wait(1, 0x09))
        assert math.isfinite(position + velocity)
    assert arm.servos[1].is_energised
    flow.send(1, 0x07, struct.pack("<I", 1))
    flow.wait_for_state(1, 1)


def test_can_param_access__version_write_read__by_endpoint_number(flow):
    flow.send(0, 0x00)
    numbers = struct.unpack("<BBBBBBBB", flow.wait(0, 0x00))
    assert numbers[4:7] == (0, 6, 10)
    number = EMULATED.ids[Endpoint.VEL_LIMIT]
    flow.send(0, 0x04, struct.pack("<BHBf", 1, number, 0, 1.234))
    flow.send(0, 0x04, struct.pack("<BHB", 0, number, 0))
    _, found, _, value = struct.unpack("<BHBf", flow.wait(0, 0x05))
    assert found == number
    assert value == pytest.approx(1.234)
