"""Bytes <-> values of ODrive's CANSimple: constants and pure functions.

Shared by the master and the emulated drive. Nothing here does I/O, keeps state, or raises for
bytes that came from a wire: a parser returns None for what is not a message of its kind. All
values are the motor's, in turns and newton metres, little-endian.
Sources: ODrive documentation "CAN Protocol" (firmware 0.6), odrive-cansimple-0.6.10.dbc, and the
vendor's examples can_simple.py, can_enumerate.py, can_param_access.py (ODriveResources).
"""

import math
from enum import IntEnum, IntFlag
from struct import Struct
from typing import NamedTuple

NODE_BITS = 5
BROADCAST_NODE = 0x3F
"""Addresses every drive, and is the node id of one that has none yet."""
MAX_NODE = 0x3E


class Command(IntEnum):
    """Command ids: the low five bits of the identifier."""

    VERSION = 0x00
    HEARTBEAT = 0x01
    ESTOP = 0x02
    ERROR = 0x03
    RX_SDO = 0x04
    TX_SDO = 0x05
    ADDRESS = 0x06
    AXIS_STATE = 0x07
    ENCODER = 0x09
    CONTROLLER_MODE = 0x0B
    INPUT_POS = 0x0C
    INPUT_VEL = 0x0D
    INPUT_TORQUE = 0x0E
    LIMITS = 0x0F
    IQ = 0x14
    TEMPERATURE = 0x15
    REBOOT = 0x16
    BUS = 0x17
    CLEAR_ERRORS = 0x18
    ABSOLUTE_POSITION = 0x19
    POS_GAIN = 0x1A
    VEL_GAINS = 0x1B
    TORQUES = 0x1C
    POWERS = 0x1D


class AxisState(IntEnum):
    """States as the heartbeat reports them, and as 0x07 asks for them."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION_SEQUENCE = 3
    MOTOR_CALIBRATION = 4
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP_CONTROL = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11
    ENCODER_HALL_POLARITY_CALIBRATION = 12
    ENCODER_HALL_PHASE_CALIBRATION = 13
    ANTICOGGING_CALIBRATION = 14


class ProcedureResult(IntEnum):
    """How the last request of a state went."""

    SUCCESS = 0
    BUSY = 1
    CANCELLED = 2
    DISARMED = 3
    NO_RESPONSE = 4
    POLE_PAIR_CPR_MISMATCH = 5
    PHASE_RESISTANCE_OUT_OF_RANGE = 6
    PHASE_INDUCTANCE_OUT_OF_RANGE = 7
    UNBALANCED_PHASES = 8
    INVALID_MOTOR_TYPE = 9
    ILLEGAL_HALL_STATE = 10
    TIMEOUT = 11
    HOMING_WITHOUT_ENDSTOP = 12
    INVALID_STATE = 13
    NOT_CALIBRATED = 14
    NOT_CONVERGING = 15


class AxisError(IntFlag):
    """Bits of the active errors and of the disarm reason."""

    INITIALIZING = 0x1
    SYSTEM_LEVEL = 0x2
    TIMING_ERROR = 0x4
    MISSING_ESTIMATE = 0x8
    BAD_CONFIG = 0x10
    DRV_FAULT = 0x20
    MISSING_INPUT = 0x40
    DC_BUS_OVER_VOLTAGE = 0x100
    DC_BUS_UNDER_VOLTAGE = 0x200
    DC_BUS_OVER_CURRENT = 0x400
    DC_BUS_OVER_REGEN_CURRENT = 0x800
    CURRENT_LIMIT_VIOLATION = 0x1000
    MOTOR_OVER_TEMP = 0x2000
    INVERTER_OVER_TEMP = 0x4000
    VELOCITY_LIMIT_VIOLATION = 0x8000
    POSITION_LIMIT_VIOLATION = 0x1_0000
    WATCHDOG_TIMER_EXPIRED = 0x100_0000
    ESTOP_REQUESTED = 0x200_0000
    SPINOUT_DETECTED = 0x400_0000
    BRAKE_RESISTOR_DISARMED = 0x800_0000
    THERMISTOR_DISCONNECTED = 0x1000_0000
    CALIBRATION_ERROR = 0x4000_0000


class ControlMode(IntEnum):
    """First number of 0x0B."""

    VOLTAGE = 0
    TORQUE = 1
    VELOCITY = 2
    POSITION = 3


POSITION_MAX_REV = float(2**24)
"""Beyond, single precision resolves less than a turn."""
INPUT_PASSTHROUGH = 1
"""Second number of 0x0B: the input is the set-point."""

U32, F32 = Struct("<I"), Struct("<f")
U32_PAIR, F32_PAIR = Struct("<II"), Struct("<ff")
_HEARTBEAT = Struct("<IBBB")
_VERSION = Struct("<8B")
_SDO = Struct("<BHB")
_U32_MASK = 0xFFFF_FFFF


def can_id(node: int, command: int) -> int:
    """Return the identifier of a node's command (CAN Protocol, "CAN Frame")."""
    return node << NODE_BITS | command


def describe_errors(bits: int) -> str:
    """Name the error bits in the vendor's words; unknown ones in hexadecimal.

    Example:
        >>> describe_errors(0x0100_0020)
        'DRV_FAULT, WATCHDOG_TIMER_EXPIRED'
    """
    names = [flag.name for flag in AxisError if flag.name and bits & flag]
    unknown = bits & _U32_MASK & ~_KNOWN_ERRORS
    if unknown:
        names.append(f"0x{unknown:08X}")
    return ", ".join(names) or "none"


_KNOWN_ERRORS = sum(AxisError)


def describe_state(state: int) -> str:
    """Name an axis state in the vendor's word."""
    return AxisState(state).name if state in _STATES else f"state {state}"


_STATES = frozenset(AxisState)


def describe_result(result: int) -> str:
    """Name a procedure result in the vendor's word."""
    return ProcedureResult(result).name if result in _RESULTS else f"result {result}"


_RESULTS = frozenset(ProcedureResult)


class Heartbeat(NamedTuple):
    """0x01: active errors, axis state, result of the last request, trajectory done."""

    errors: int
    state: int
    result: int
    is_trajectory_done: bool


def pack_heartbeat(beat: Heartbeat) -> bytes:
    """Payload of 0x01."""
    return _HEARTBEAT.pack(beat.errors, beat.state, beat.result, beat.is_trajectory_done) + b"\0"


def parse_heartbeat(data: bytes) -> Heartbeat | None:
    """Return a heartbeat, None if the payload is shorter than 7 bytes."""
    if len(data) < _HEARTBEAT.size:
        return None
    errors, state, result, flags = _HEARTBEAT.unpack_from(data)
    return Heartbeat(errors, state, result, bool(flags & 1))


class Version(NamedTuple):
    """0x00: protocol version, hardware (line, version, variant), firmware."""

    protocol: int
    hardware: tuple[int, int, int]
    firmware: tuple[int, int, int]
    is_unreleased: bool


def pack_version(version: Version) -> bytes:
    """Payload of 0x00."""
    protocol, hardware, firmware, is_unreleased = version
    return _VERSION.pack(protocol, *hardware, *firmware, is_unreleased)


def parse_version(data: bytes) -> Version | None:
    """Return the version, None if the payload is not 8 bytes."""
    if len(data) != _VERSION.size:
        return None
    numbers = _VERSION.unpack(data)
    return Version(numbers[0], numbers[1:4], numbers[4:7], bool(numbers[7]))


class Address(NamedTuple):
    """0x06: a node id and the 48-bit serial number of the drive that has, or shall have, it."""

    node: int
    serial: int


def pack_address(address: Address, connection: int | None = 0) -> bytes:
    """Payload of 0x06; firmware before 0.6.11 has no connection id (None)."""
    data = bytes((address.node,)) + address.serial.to_bytes(6, "little")
    return data if connection is None else data + bytes((connection,))


def parse_address(data: bytes) -> Address | None:
    """Return an address, None if the payload is shorter than 7 bytes."""
    if len(data) < 7:
        return None
    return Address(data[0], int.from_bytes(data[1:7], "little"))


def parse_u32(data: bytes) -> int | None:
    """Return the first number of a payload, None if it is too short. More bytes are ignored."""
    return int(U32.unpack_from(data)[0]) if len(data) >= U32.size else None


def parse_u32_pair(data: bytes) -> tuple[int, int] | None:
    """Return both numbers of a payload, None if it is too short."""
    return U32_PAIR.unpack_from(data) if len(data) >= U32_PAIR.size else None


def parse_f32(data: bytes) -> float | None:
    """Return the first number of a payload (4 or 8 bytes for 0x0E), None if it is too short."""
    return float(F32.unpack_from(data)[0]) if len(data) >= F32.size else None


def parse_f32_pair(data: bytes) -> tuple[float, float] | None:
    """Return both numbers of a payload, None if it is too short. They may be NaN or infinite."""
    return F32_PAIR.unpack_from(data) if len(data) >= F32_PAIR.size else None


# --- endpoints (0x04, 0x05) ---------------------------------------------------------------------

OPCODE_READ, OPCODE_WRITE = 0, 1


class Sdo(NamedTuple):
    """0x04 to the drive, 0x05 from it: an endpoint and up to four bytes of its value."""

    opcode: int
    endpoint: int
    value: bytes


def pack_sdo(sdo: Sdo) -> bytes:
    """Payload of 0x04 and 0x05; the opcode of 0x05 is 0."""
    return _SDO.pack(sdo.opcode, sdo.endpoint, 0) + sdo.value


def parse_sdo(data: bytes) -> Sdo | None:
    """Return an endpoint access, None if the payload is shorter than 4 bytes."""
    if len(data) < _SDO.size:
        return None
    opcode, endpoint, _ = _SDO.unpack_from(data)
    return Sdo(opcode, endpoint, data[_SDO.size :])


# --- single precision ---------------------------------------------------------------------------


def pack_f32(value: float) -> bytes:
    """Return single precision, infinite where the value is beyond its range."""
    try:
        return F32.pack(value)
    except OverflowError:
        return F32.pack(math.copysign(math.inf, value))


def f32_below(value: float) -> float:
    """Return the largest single-precision number that is not above a positive value."""
    rounded = float(F32.unpack(pack_f32(value))[0])
    if rounded <= value:
        return rounded
    return float(F32.unpack(U32.pack(U32.unpack(F32.pack(rounded))[0] - 1))[0])


def f32_spacing(value: float) -> float:
    """Return the distance between neighbouring single-precision numbers about a value."""
    _, exponent = math.frexp(max(abs(value), 2.0**-126))
    return math.ldexp(1.0, exponent - 24)
