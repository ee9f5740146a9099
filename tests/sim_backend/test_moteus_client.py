"""Conformance: mjbots' own `moteus` library drives the emulated controllers over the hub.

Unmodified, through its python-can transport. Everything is real: the Unix socket, the python-can
plugin, CAN FD frames, the emulator with its arm by the wall clock (in a thread).
"""

import asyncio
import math
import tempfile
import threading

import can
import moteus
import pytest
from moteus.moteus import CommandError

from sim_backend.arm import Arm
from sim_backend.emulator import Emulator
from sim_backend.hub import UnixHub
from sim_backend.moteus.node import MoteusNode
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.server import EmulatorServer
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings

WAIT_S = 10.0
REG, MODE = moteus.Register, moteus.Mode
PATIENT_S = 2.0
"""Watchdog where a test is not about it: the machine may be busy."""


class EmulatedArm:
    """Two controllers and their arm behind a hub, by the wall clock, in a thread."""

    def __init__(self, path):
        self._hub = UnixHub(path)
        self.servos = [Servo(settings) for settings in servo_preset("bench")]
        self.nodes = [
            MoteusNode(node_id, servo, self._hub.transmit)
            for node_id, servo in enumerate(self.servos, start=1)
        ]
        emulator = Emulator(Arm(plant_preset("bench")), self.servos, self.nodes, is_lockstep=False)
        server = EmulatorServer(emulator, self._hub, EmulatorSettings(time="wall"))
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
        arm.path = f"{folder}/bus"
        yield arm
        arm.close()


@pytest.fixture
def run(arm, monkeypatch):
    """Run a scenario: a coroutine function that takes the library's transport."""
    monkeypatch.setattr(can, "rc", dict(can.rc))  # the library asks all buses for CAN FD there

    def run_scenario(scenario):
        async def whole():
            transport = moteus.PythonCan(interface="hil-unix", channel=arm.path)
            try:
                return await asyncio.wait_for(scenario(transport), WAIT_S)
            finally:
                transport.close()

        return asyncio.run(whole())

    return run_scenario


async def reach(controller, mode, **position):
    """Send a position command until the controller is in a mode; return the last result."""
    while True:
        result = await controller.set_position(
            **{"watchdog_timeout": PATIENT_S, "query": True, **position}
        )
        if result.values[REG.MODE] == mode:
            return result


def torque(value_Nm):
    """Torque control as the vendor's guide has it (docs/guides/control-modes.md)."""
    return {
        "position": math.nan,
        "velocity": 0.0,
        "kp_scale": 0.0,
        "kd_scale": 0.0,
        "ilimit_scale": 0.0,
        "feedforward_torque": value_Nm,
    }


def test_moteus_library__query__registers_of_both_controllers(arm, run):
    async def scenario(transport):
        first, second = (moteus.Controller(id=i, transport=transport) for i in (1, 2))
        return await transport.cycle([first.make_query(), second.make_query()])

    results = run(scenario)
    assert [result.id for result in results] == [1, 2]
    for result, servo in zip(results, arm.servos, strict=True):
        values = result.values
        assert values[REG.MODE] == MODE.STOPPED
        assert values[REG.POSITION] == pytest.approx(servo.q_rad / math.tau, abs=1e-3)
        assert values[REG.VOLTAGE] == 48.0
        assert values[REG.TEMPERATURE] == 25.0
        assert values[REG.FAULT] == 0


def test_moteus_library__identity__only_as_32_bits_and_unknown_registers_are_left_out(run):
    wanted = {
        REG.MODEL_NUMBER: moteus.INT32,
        REG.FIRMWARE_VERSION: moteus.INT32,
        REG.REGISTER_MAP_VERSION: moteus.INT8,
        REG.SERIAL_NUMBER3: moteus.INT32,
    }

    async def scenario(transport):
        controller = moteus.Controller(id=1, transport=transport)
        return (await controller.custom_query(wanted)).values

    assert run(scenario) == {
        REG.MODEL_NUMBER: 0x48494C31,
        REG.FIRMWARE_VERSION: 0x010100,
        REG.SERIAL_NUMBER3: 0x48494C31,
    }


@pytest.mark.parametrize("resolution", [moteus.INT8, moteus.INT16, moteus.INT32, moteus.F32])
def test_moteus_library__torque_mode_in_each_resolution__reaches_the_motor(arm, run, resolution):
    class Resolution(moteus.PositionResolution):
        feedforward_torque = kp_scale = kd_scale = position = velocity = resolution
        ilimit_scale = maximum_torque = resolution

    async def scenario(transport):
        controller = moteus.Controller(id=2, transport=transport, position_resolution=Resolution())
        await reach(controller, MODE.POSITION, **torque(1.5), maximum_torque=2.0)
        demand = arm.servos[1].torque_target_Nm
        await reach(controller, MODE.POSITION, **torque(-3.0), maximum_torque=2.0)
        result = await controller.query()
        return demand, arm.servos[1].torque_target_Nm, result.values[REG.FAULT]

    assert run(scenario) == pytest.approx((1.5, -2.0, 102), abs=0.01)


def test_moteus_library__watchdog__latches_mode_11_until_stop(arm, run):
    async def scenario(transport):
        controller = moteus.Controller(id=1, transport=transport)
        await reach(controller, MODE.POSITION, **torque(0.5), watchdog_timeout=0.5)
        while (await controller.query()).values[REG.MODE] != MODE.TIMEOUT:
            assert arm.servos[0].torque_target_Nm == pytest.approx(0.5)
        for _ in range(5):
            result = await controller.set_position(**torque(0.5), query=True)
            assert result.values[REG.MODE] == MODE.TIMEOUT
        await controller.set_stop()
        stopped = (await controller.query()).values[REG.MODE]
        again = await reach(controller, MODE.POSITION, **torque(0.0))
        return stopped, again.values[REG.MODE]

    assert run(scenario) == (MODE.STOPPED, MODE.POSITION)


def test_moteus_library__position_command_with_gains__turns_the_shaft_there(arm, run):
    async def scenario(transport):
        controller = moteus.Controller(id=2, transport=transport)
        stream = moteus.Stream(controller, use_flow_control=False)
        for name, value in (("kp", 60.0), ("kd", 8.0)):
            await stream.command(f"conf set servo.pid_position.{name} {value}".encode())
        start = (await controller.query()).values[REG.POSITION]
        goal = start + 0.05
        result = await reach(controller, MODE.POSITION, position=goal)
        while abs(result.values[REG.POSITION] - goal) > 0.01:
            result = await reach(controller, MODE.POSITION, position=goal)
        return True

    assert run(scenario)


def test_moteus_library__fault__latches_until_stop_and_names_its_code(arm, run):
    async def scenario(transport):
        controller = moteus.Controller(id=1, transport=transport)
        await reach(controller, MODE.POSITION, **torque(0.5))
        arm.nodes[0].controller.fail(33)
        faulted = await controller.set_position(**torque(0.5), query=True)
        assert not arm.servos[0].is_energised
        await controller.set_stop()
        return faulted.values, (await controller.query()).values

    faulted, stopped = run(scenario)
    assert (faulted[REG.MODE], faulted[REG.FAULT]) == (MODE.FAULT, 33)
    assert (stopped[REG.MODE], stopped[REG.FAULT]) == (MODE.STOPPED, 0)


def test_moteus_library__console__reads_writes_and_refuses(arm, run):
    async def scenario(transport):
        stream = moteus.Stream(moteus.Controller(id=1, transport=transport))
        await stream.flush_read(0.05)
        await stream.command(b"tel stop")
        before = await stream.command(b"conf get servo.timeout_mode", allow_any_response=True)
        assert await stream.command(b"conf set servo.timeout_mode 0") == b""
        after = await stream.command(b"conf get servo.timeout_mode", allow_any_response=True)
        listed = await stream.command(b"conf enumerate")
        with pytest.raises(CommandError, match="ERR"):
            await stream.command(b"conf set no.such 1")
        return before, after, listed

    before, after, listed = run(scenario)
    assert (before, after) == (b"12", b"0")
    assert b"servo.timeout_mode 0\n" in listed
    assert b"motor_position.sources.0.cpr 4096\n" in listed


def test_moteus_library__addressed_by_uuid__only_that_controller_obeys(arm, run):
    async def scenario(transport):
        broadcast = moteus.Controller(id=0x7F, transport=transport)
        await broadcast.set_stop()
        (first,) = [d for d in await transport.discover() if d.can_id == 1]
        address = moteus.DeviceAddress(uuid=first.uuid)
        controller = moteus.Controller(id=address, transport=transport)
        await controller.execute(controller.make_current(d_A=0.0, q_A=1.0))
        while arm.nodes[0].controller.mode != MODE.CURRENT:
            await asyncio.sleep(0.001)
        return [node.controller.mode for node in arm.nodes]

    assert run(scenario) == [MODE.CURRENT, MODE.STOPPED]


def test_moteus_library__set_output__the_present_position_is_called_so(run):
    async def scenario(transport):
        controller = moteus.Controller(id=1, transport=transport)
        before = (await controller.query()).values[REG.POSITION]
        await controller.set_output_nearest(position=3.1)
        nearest = (await controller.query()).values[REG.POSITION]
        await controller.set_output_exact(position=0.25)
        return before, nearest, (await controller.query()).values[REG.POSITION]

    before, nearest, exact = run(scenario)
    assert (nearest - before) % 1.0 == pytest.approx(0.0, abs=1e-6)
    assert abs(nearest - 3.1) <= 0.5
    assert exact == pytest.approx(0.25, abs=1e-6)
