"""Bytes <-> values of MIT mode with 11-bit identifiers: Damiao, T-Motor, CubeMars.

Shared by the master and the emulated drive. Nothing here does I/O, keeps state, or raises for
bytes that came from a wire: a parser returns None for what is not a message of its kind.

Every quantity is an unsigned number that spans a symmetric range end to end, so that zero lies
half-way between two codes and cannot be sent. Torque codes here are the nearest ones; the vendors'
own samples truncate. At exactly zero both give 7FF, half a step below zero.

Sources: Damiao DM-J4310-2EC manual V1.0 (MIT mode, feedback frame, registers); CubeMars "AK Series
Actuator Driver Manual" V1.0.8, 5.3; B. Katz, "HKC_MiniCheetah" firmware, `CAN_com.cpp`.
"""

from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from drivers.frame import EFF_FLAG

REGISTER_ID = 0x7FF
"""Identifier of Damiao's register requests, to all drives."""
INJECT_FAULT_ID = EFF_FLAG | 0x1FFF_FE00
"""Plus the node id: puts an *emulated* drive into fault. No real drive of any variant knows it."""
INJECT_FAULT_DATA = b"HILFAULT"

SPECIAL_HEAD = b"\xff" * 7
"""A command frame that begins so is no set-point; its last byte says what it is."""
ENABLE = SPECIAL_HEAD + b"\xfc"
DISABLE = SPECIAL_HEAD + b"\xfd"
SET_ZERO = SPECIAL_HEAD + b"\xfe"
CLEAR_FAULT = SPECIAL_HEAD + b"\xfb"
"""Damiao only."""

FEEDBACK_BYTES = 8
SHORT_FEEDBACK_BYTES = 6
"""Mini-cheetah and T-Motor: without temperature and error."""
FEEDBACK = Struct(">BHHB")
"""Identifier (Damiao: and status << 4), position, velocity << 4 | torque >> 8, torque & FF."""
FEEDBACK_TAIL = Struct(">BB")
"""Damiao: MOSFET and rotor temperature, degC. CubeMars: motor temperature, error."""

POSITION_CODES = 0xFFFF
SHORT_CODES = 0xFFF
"""Velocity, gains and torque have 12 bits."""
ZERO_POSITION = 0x7FFF
ZERO_SHORT = 0x7FF

_COMMAND = Struct(">HBBHH")


class Ranges(NamedTuple):
    """What the codes span: +- for motion and torque, from 0 for the gains. At the output shaft."""

    position_rad: float
    velocity_rad_s: float
    torque_Nm: float
    kp_Nm_rad: float = 500.0
    kd_Nms_rad: float = 5.0


class Codes(NamedTuple):
    """A set-point as numbers: tau = kp (p - q) + kd (v - dq) + t."""

    position: int
    velocity: int
    kp: int
    kd: int
    torque: int


class Setpoint(NamedTuple):
    """A set-point in SI."""

    position_rad: float
    velocity_rad_s: float
    kp_Nm_rad: float
    kd_Nms_rad: float
    torque_Nm: float


class Feedback(NamedTuple):
    """A drive's reply as numbers. `head` is its first byte, `tail` the last two, 0 if absent."""

    head: int
    position: int
    velocity: int
    torque: int
    tail: tuple[int, int]


class DamiaoStatus(IntEnum):
    """Upper half of a Damiao reply's first byte."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    MOS_OVER_TEMPERATURE = 0xB
    ROTOR_OVER_TEMPERATURE = 0xC
    LOST_COMMUNICATION = 0xD
    OVERLOAD = 0xE


CUBEMARS_ERRORS = {
    1: "over voltage",
    2: "under voltage",
    3: "drive fault",
    4: "over current",
    5: "MOSFET over temperature",
    6: "motor over temperature",
    7: "gate driver over voltage",
    8: "gate driver under voltage",
    9: "MCU under voltage",
    10: "booted from a watchdog reset",
}
"""Last byte of a CubeMars reply, by the manual V1.0.8 (5.2.2); later firmware numbers differ."""


class RegisterCommand(IntEnum):
    """Third byte of a frame about a Damiao register; replies repeat it."""

    READ = 0x33
    WRITE = 0x55
    SAVE = 0xAA
    REFRESH = 0xCC
    """Asks for a feedback frame and changes nothing."""


class Register(IntEnum):
    """Damiao registers in use here."""

    MASTER_ID = 7
    NODE_ID = 8
    TIMEOUT = 9
    """Command watchdog in units of 50 us, 0 = off."""
    CONTROL_MODE = 10
    HARDWARE_VERSION = 13
    SOFTWARE_VERSION = 14
    SERIAL = 15
    GEAR_RATIO = 20
    POSITION_RANGE = 21
    VELOCITY_RANGE = 22
    TORQUE_RANGE = 23


TIMEOUT_UNITS_PER_MS = 20
MIT_MODE = 1
"""Value of the control mode register."""

HIL_SERIAL = 0x48494C31
"""Serial number of the emulated drive, "HIL1"; together with one of these hardware versions no
real drive has it."""
HIL_LOCKSTEP = 0x4C4F434B
"""Hardware version of an emulated drive whose time follows the master's cycle, "LOCK"."""
HIL_WALL = 0x57414C4C
"""Hardware version of an emulated drive that runs by the clock, "WALL"."""


# --- numbers <-> SI -------------------------------------------------------------------------------


def to_code(value: float, span: float, codes: int) -> int:
    """Return the number nearest to `value` in -span..+span; outside it the end, NaN the middle.

    Args:
        value: In the unit of `span`.
        span: Largest magnitude, > 0.
        codes: The largest number: 65535 or 4095.
    """
    if -span < value < span:
        return codes - int(0.5 * codes * (1.0 - value / span) + 0.5)
    if value >= span:
        return codes
    return 0 if value <= -span else codes // 2


def to_value(code: int, span: float, codes: int) -> float:
    """Return what a number stands for."""
    return code * 2.0 * span / codes - span


def gain_to_code(value: float, span: float, codes: int) -> int:
    """The same for a gain, which spans 0..span."""
    if 0.0 < value < span:
        return int(value * codes / span + 0.5)
    return codes if value >= span else 0


def torque_codes_within(torque_max_Nm: float, range_Nm: float, codes: int) -> tuple[int, int]:
    """Return the lowest and highest torque number whose magnitude is at most `torque_max_Nm`."""
    step_Nm = 2.0 * range_Nm / codes
    high = min(codes, int((range_Nm + torque_max_Nm) / step_Nm * (1.0 + 1e-12)))
    return codes - high, high


# --- command --------------------------------------------------------------------------------------


def pack_codes(codes: Codes) -> bytes:
    """Payload of a command frame: p 16, v 12, kp 12, kd 12, t 12 bits, big-endian."""
    p, v, kp, kd, t = codes
    return _COMMAND.pack(p, v >> 4, (v & 0xF) << 4 | kp >> 8, (kp & 0xFF) << 8 | kd >> 4,
                         (kd & 0xF) << 12 | t)  # fmt: skip


def parse_command(data: bytes) -> Codes | None:
    """Return a set-point's numbers; None for a special frame or a wrong length."""
    if len(data) != 8 or data.startswith(SPECIAL_HEAD):
        return None
    p, v_high, mixed, middle, low = _COMMAND.unpack(data)
    return Codes(
        p,
        v_high << 4 | mixed >> 4,
        (mixed & 0xF) << 8 | middle >> 8,
        (middle & 0xFF) << 4 | low >> 12,
        low & 0xFFF,
    )


def pack_setpoint(setpoint: Setpoint, ranges: Ranges) -> bytes:
    """Payload of a command frame from SI; what is out of range is sent as the range's end."""
    return pack_codes(
        Codes(
            to_code(setpoint.position_rad, ranges.position_rad, POSITION_CODES),
            to_code(setpoint.velocity_rad_s, ranges.velocity_rad_s, SHORT_CODES),
            gain_to_code(setpoint.kp_Nm_rad, ranges.kp_Nm_rad, SHORT_CODES),
            gain_to_code(setpoint.kd_Nms_rad, ranges.kd_Nms_rad, SHORT_CODES),
            to_code(setpoint.torque_Nm, ranges.torque_Nm, SHORT_CODES),
        )
    )


def to_setpoint(codes: Codes, ranges: Ranges, *, wide: bool = False) -> Setpoint:
    """Return what a set-point's numbers mean.

    Args:
        codes: As parsed.
        ranges: What they span.
        wide: All numbers have 16 bits, as with 29-bit identifiers.
    """
    largest = POSITION_CODES if wide else SHORT_CODES
    return Setpoint(
        to_value(codes.position, ranges.position_rad, POSITION_CODES),
        to_value(codes.velocity, ranges.velocity_rad_s, largest),
        codes.kp * ranges.kp_Nm_rad / largest,
        codes.kd * ranges.kd_Nms_rad / largest,
        to_value(codes.torque, ranges.torque_Nm, largest),
    )


# --- feedback -------------------------------------------------------------------------------------


def pack_feedback(feedback: Feedback, length: int = FEEDBACK_BYTES) -> bytes:
    """Payload of a reply of 6 or 8 bytes."""
    head, p, v, t, tail = feedback
    body = FEEDBACK.pack(head, p, v << 4 | t >> 8, t & 0xFF)
    return body if length == SHORT_FEEDBACK_BYTES else body + FEEDBACK_TAIL.pack(*tail)


def parse_feedback(data: bytes) -> Feedback | None:
    """Return a reply's numbers, None if its length is neither 6 nor 8."""
    if len(data) not in (SHORT_FEEDBACK_BYTES, FEEDBACK_BYTES):
        return None
    head, p, mixed, t_low = FEEDBACK.unpack_from(data)
    tail = (data[6], data[7]) if len(data) == FEEDBACK_BYTES else (0, 0)
    return Feedback(head, p, mixed >> 4, (mixed & 0xF) << 8 | t_low, tail)


# --- Damiao registers -----------------------------------------------------------------------------

_REGISTER = Struct("<HBB4s")
F32, U32 = Struct("<f"), Struct("<I")


class RegisterFrame(NamedTuple):
    """A request to, or a reply from, one drive about one register."""

    node_id: int
    command: int
    register: int
    raw: bytes


def pack_register(
    node_id: int, command: RegisterCommand, register: int, raw: bytes = b"\0\0\0\0"
) -> bytes:
    """Payload of a register frame, request or reply.

    Args:
        node_id: The drive's identifier (ESC_ID).
        command: What to do; REFRESH has register 0.
        register: Its number.
        raw: Its value, 4 bytes little-endian: `F32` or `U32`.
    """
    return _REGISTER.pack(node_id, command, register, raw)


_REGISTER_COMMANDS = frozenset(int(command) for command in RegisterCommand)


def parse_register(data: bytes) -> RegisterFrame | None:
    """Return a register frame, None if the payload is not one."""
    if len(data) != _REGISTER.size or data[2] not in _REGISTER_COMMANDS:
        return None
    return RegisterFrame._make(_REGISTER.unpack(data))
