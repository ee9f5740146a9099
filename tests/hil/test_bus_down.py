"""A bus that is away for a while: the fault is latched once, and the arm comes back by command."""

import numpy as np
import pytest

from controller.errors import CommandError
from controller.faults import FaultCode
from controller.machine import State
from drivers.cia402 import codec
from drivers.errors import BusDownError
from drivers.frame import unpack_frame
from tests.hil.virtual import Rig


class Interface:
    """The wire between a rig's bus and its drives, which can be taken away and put back."""

    def __init__(self, rig):
        self._rig = rig
        self._is_down = False
        rig.loopback.connect(self._carry, rig._wait)

    def _carry(self, frame):
        if self._is_down:
            raise BusDownError("no bus can7: the interface is down; `ip link set can7 up`")
        if not self._rig.lose_to_drives(*unpack_frame(frame)):
            self._rig.emulator.receive(frame)

    def down(self, cycles):
        """Take it down for so many cycles; the drives' time goes on."""
        self._is_down = True
        for _ in range(cycles):
            self._rig.step()
            self._rig.emulator.advance(1_000_000)

    def up(self):
        self._is_down = False


def faults(rig):
    return [detail for kind, detail in rig.events if kind == "fault"]


def drives_are(rig, state):
    return all(codec.decode_state(n.drive.statusword()) is state for n in rig.emulator._nodes)


@pytest.mark.parametrize("cycles", [1, 50, 1000])
def test_bus__down_in_motion__trips_once_with_one_line_and_stays_off(cycles):
    rig = Rig()
    interface = Interface(rig)
    rig.swing()
    interface.down(cycles)
    assert rig.state is State.FAULT
    assert rig.fault is FaultCode.BUS_FAILED
    (fault,) = faults(rig)
    assert fault["code"] == "BUS_FAILED"
    assert fault["reaction"] == "TORQUE_OFF"
    assert fault["detail"] == "no bus can7: the interface is down; `ip link set can7 up`"
    assert rig.control.tau_sent_Nm == [0.0, 0.0]
    interface.up()
    rig.step(300)
    assert rig.state is State.FAULT  # nothing comes back by itself
    assert rig.emulator.tau_applied_Nm == [0.0, 0.0]
    assert len(faults(rig)) == 1


def test_bus__down_in_motion__drives_own_watchdogs_remove_torque():
    rig = Rig()
    interface = Interface(rig)
    rig.swing()
    interface.down(50)
    assert drives_are(rig, codec.Cia402State.FAULT)
    assert rig.emulator.tau_applied_Nm == [0.0, 0.0]


def test_bus__up_again__reset_and_enable_bring_the_arm_back():
    rig = Rig()
    interface = Interface(rig)
    rig.swing()
    interface.down(50)  # long enough for the drives' watchdogs
    interface.up()
    rig.step(100)
    with pytest.raises(CommandError, match="FAULT; reset first"):
        rig.control.enable()
    rig.control.reset()
    rig.step(50)
    rig.enable()
    rig.step(2000)
    assert rig.state is State.READY
    assert np.abs(rig.column("q", 1) - rig.column("q_des", 1)).max() < 0.05


def test_bus__still_down__reset_does_not_help():
    rig = Rig()
    interface = Interface(rig)
    rig.enable()
    interface.down(10)
    rig.control.reset()
    interface.down(1)
    assert rig.fault is FaultCode.BUS_FAILED
    assert len(faults(rig)) == 2


def test_bus__down_without_power__trips_too():
    rig = Rig()
    interface = Interface(rig)
    interface.down(5)
    assert rig.state is State.FAULT
    assert len(faults(rig)) == 1
