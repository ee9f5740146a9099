"""The drive application: state machine, power stage and torque scaling in front of one servo."""

import math

from drivers.cia402.codec import (
    CST,
    STATUS_FOLLOWS_COMMAND,
    STATUS_INTERNAL_LIMIT,
    STATUS_REMOTE,
    STATUS_VOLTAGE_ENABLED,
    Cia402State,
    Index,
)
from drivers.cia402.sdo import SdoAbort
from sim_backend.cia402.dictionary import ObjectDictionary
from sim_backend.cia402.drive_state import QUICK_STOP_OPTIONS, DriveStateMachine
from sim_backend.cia402.emergency import Emergency
from sim_backend.servo import Servo

MODES = (0, CST)
"""What 6060 accepts: no mode, and cyclic synchronous torque."""

_I16_MIN, _I16_MAX = -0x8000, 0x7FFF
_U16_MAX = 0xFFFF
_ROUNDING = 1.0 + 1e-12
"""A peak that is a whole number of per mille stays one, in spite of binary fractions."""
_I32_MIN, _I32_MAX = -0x8000_0000, 0x7FFF_FFFF


class Drive:
    """What the objects 6040 to 6078 act on and show. Torque is per mille of `rated_torque_mNm`.

    The servo is energised in OPERATION ENABLED and QUICK STOP ACTIVE, and follows the target
    torque only in OPERATION ENABLED with mode 10 (cyclic synchronous torque).

    Attributes:
        machine: State machine; change it through the methods here, so that the servo follows.
        mode: 6060 and 6061; 0 or 10.
        target_torque: 6071 as last written.
        max_torque: 6072, the limit on either side; what the servo can do is one as well.
        rated_torque_mNm: 6076.
        rated_current_mA: 6075.
    """

    __slots__ = (
        "_A_per_mille",
        "_Nm_per_mille",
        "_counts_per_rad",
        "_emergency",
        "_is_clipped",
        "_is_following",
        "_peak_torque",
        "_servo",
        "_status_base",
        "machine",
        "max_torque",
        "mode",
        "rated_current_mA",
        "rated_torque_mNm",
        "target_torque",
    )

    def __init__(self, servo: Servo, rated_torque_Nm: float, emergency: Emergency) -> None:
        self._servo = servo
        self._emergency = emergency
        self.rated_torque_mNm = max(1, round(rated_torque_Nm * 1e3))
        self.rated_current_mA = max(
            1, round(rated_torque_Nm / servo.settings.torque_constant_Nm_A * 1e3)
        )
        self._Nm_per_mille = self.rated_torque_mNm * 1e-6
        self._A_per_mille = self.rated_current_mA * 1e-6
        self._counts_per_rad = servo.counts_per_turn / math.tau
        self._peak_torque = math.floor(servo.torque_max_Nm / self._Nm_per_mille * _ROUNDING)
        self.machine = DriveStateMachine()
        self.power_on()

    def power_on(self) -> None:
        """Take the state after power-up: no mode, torque 0, limit at what the servo can do."""
        self.mode = 0
        self.target_torque = 0
        self.max_torque = min(self._peak_torque, _U16_MAX)
        self.machine.initialise()
        self._follow_state()

    # --- commands ---------------------------------------------------------------------------

    def control(self, controlword: int) -> None:
        """Obey a controlword (6040)."""
        machine = self.machine
        before = machine.state
        if controlword == machine.controlword and before is Cia402State.OPERATION_ENABLED:
            return  # a repeated command has nothing left to do
        machine.command(controlword)
        if machine.state is not before:
            self._follow_state()
            if before is Cia402State.FAULT:
                self._emergency.clear_all()

    def set_target_torque(self, per_mille: int) -> None:
        """Take a target torque (6071)."""
        self.target_torque = per_mille
        if self._is_following:
            self._apply_torque()

    def set_max_torque(self, per_mille: int) -> None:
        """Take a torque limit (6072), effective at once."""
        self.max_torque = per_mille
        if self._is_following:
            self._apply_torque()

    def fail(self, code: int) -> None:
        """Enter fault: power off at once, then the emergency message."""
        self.machine.fail()
        self._follow_state()
        self._emergency.raise_error(code)

    def quick_stop(self) -> None:
        """Quick stop on the drive's own decision."""
        self.machine.quick_stop()
        self._follow_state()

    def disable_voltage(self) -> None:
        """Remove power on the drive's own decision."""
        self.machine.disable_voltage()
        self._follow_state()

    def settle(self) -> None:
        """Make the transitions the drive makes by itself; call it once per tick."""
        before = self.machine.state
        self.machine.settle()
        if self.machine.state is not before:
            self._follow_state()

    # --- actual values ----------------------------------------------------------------------

    def statusword(self) -> int:
        """6041. Bit 11: the target is limited by 6072, or the servo by current or supply."""
        if self._is_following and (self._is_clipped or self._servo.is_saturated):
            return self._status_base | STATUS_INTERNAL_LIMIT
        return self._status_base

    def position(self) -> int:
        """6064, single-turn encoder counts."""
        return self._servo.counts

    def velocity(self) -> int:
        """606C, counts/s, from the joint's rate and so without encoder noise."""
        counts_s = round(self._servo.dq_rad_s * self._counts_per_rad)
        return max(_I32_MIN, min(_I32_MAX, counts_s))

    def torque(self) -> int:
        """6077, from the winding current."""
        return _to_i16(self._servo.torque_Nm / self._Nm_per_mille)

    def current(self) -> int:
        """6078, per mille of `rated_current_mA`."""
        return _to_i16(self._servo.current_A / self._A_per_mille)

    # --- object dictionary ------------------------------------------------------------------

    def bind(self, dictionary: ObjectDictionary) -> None:
        """Put the drive behind its objects."""
        machine, bind = self.machine, dictionary.bind
        bind(Index.CONTROLWORD, read=lambda: machine.controlword, write=self.control)
        bind(Index.STATUSWORD, read=self.statusword)
        bind(Index.MODE, read=lambda: self.mode, write=self._write_mode)
        bind(Index.MODE_DISPLAY, read=lambda: self.mode)
        bind(Index.TARGET_TORQUE, read=lambda: self.target_torque, write=self.set_target_torque)
        bind(Index.MAX_TORQUE, read=lambda: self.max_torque, write=self.set_max_torque)
        bind(
            Index.QUICK_STOP_OPTION,
            read=lambda: machine.quick_stop_option,
            write=self._write_quick_stop_option,
        )
        bind(Index.POSITION_ACTUAL, read=self.position)
        bind(Index.VELOCITY_ACTUAL, read=self.velocity)
        bind(Index.TORQUE_ACTUAL, read=self.torque)
        bind(Index.CURRENT_ACTUAL, read=self.current)

    def _write_mode(self, mode: int) -> SdoAbort | None:
        if mode not in MODES:
            return SdoAbort.VALUE_RANGE
        self.mode = mode
        self._follow_state()
        return None

    def _write_quick_stop_option(self, option: int) -> SdoAbort | None:
        if option not in QUICK_STOP_OPTIONS:
            return SdoAbort.VALUE_RANGE
        self.machine.quick_stop_option = option
        return None

    # --- servo ------------------------------------------------------------------------------

    def _follow_state(self) -> None:
        state = self.machine.state
        self._servo.is_energised = self.machine.is_powered
        self._is_following = state is Cia402State.OPERATION_ENABLED and self.mode == CST
        self._status_base = state | STATUS_REMOTE | STATUS_VOLTAGE_ENABLED
        if self._is_following:
            self._status_base |= STATUS_FOLLOWS_COMMAND
            self._apply_torque()
        else:
            self._is_clipped = False
            self._servo.torque_target_Nm = 0.0

    def _apply_torque(self) -> None:
        wanted, limit = self.target_torque, min(self.max_torque, self._peak_torque)
        allowed = limit if wanted > limit else -limit if wanted < -limit else wanted
        self._is_clipped = allowed != wanted
        self._servo.torque_target_Nm = allowed * self._Nm_per_mille


def _to_i16(value: float) -> int:
    rounded = round(value)
    if _I16_MIN <= rounded <= _I16_MAX:
        return rounded
    return _I16_MIN if rounded < 0 else _I16_MAX
