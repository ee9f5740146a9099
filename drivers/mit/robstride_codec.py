"""Bytes <-> values of the protocol with 29-bit identifiers: CyberGear and RobStride.

Identifier: type << 24 | data << 8 | target. The torque of a control frame travels in the
identifier, and so do the status bits of a reply. See `drivers.mit.codec` for what holds of both.

Sources: Xiaomi "CyberGear micro-motor instruction manual", 4.1; RobStride RS00-RS06 manuals,
"private protocol" (fault report, canTimeout).
"""

from enum import IntEnum
from struct import Struct
from typing import NamedTuple

from drivers.frame import EFF_FLAG
from drivers.mit.codec import Codes

CODES = 0xFFFF
"""All quantities have 16 bits."""
ZERO = 0x7FFF
ALL_HOSTS = 0xFE
"""Target of the answer to an identity request (4.1.1)."""
FACTORY_HOST = 0xFD
"""The identifier that the vendors' tools take for themselves."""

HIL_UNIQUE_LOCKSTEP = b"HIL-LOCK"
"""MCU identifier of an emulated drive whose time follows the master's cycle."""
HIL_UNIQUE_WALL = b"HIL-WALL"
"""MCU identifier of an emulated drive that runs by the clock."""
HIL_UNIQUE = frozenset((HIL_UNIQUE_LOCKSTEP, HIL_UNIQUE_WALL))

TIMEOUT_UNITS_PER_MS = 20
"""Of canTimeout: 20000 is one second."""
FAULTS = {
    0: "under voltage",
    1: "over current",
    2: "over temperature",
    3: "magnetic encoder",
    4: "overload or Hall encoder",
    5: "not calibrated",
}
"""Bits 16 to 21 of a reply's identifier (4.1.3)."""
REPORTED_FAULTS = {
    0: "motor over temperature",
    1: "driver chip",
    2: "under voltage",
    3: "over voltage",
    4: "phase B over current",
    5: "phase C over current",
    7: "encoder not calibrated",
    14: "overload",
    16: "phase A over current",
}
"""Bits of the first word of a fault report (4.1.10)."""


class Type(IntEnum):
    """Communication types in use here (4.1)."""

    IDENTITY = 0
    CONTROL = 1
    FEEDBACK = 2
    ENABLE = 3
    STOP = 4
    """Data byte 0 = 1: clear the fault."""
    SET_ZERO = 6
    SET_NODE_ID = 7
    READ = 17
    WRITE = 18
    FAULT_REPORT = 21
    SAVE = 22


class Mode(IntEnum):
    """Bits 22 and 23 of a reply's identifier."""

    RESET = 0
    CALIBRATION = 1
    RUN = 2


class Parameter(IntEnum):
    """Parameter indices in use here (4.1.12)."""

    RUN_MODE = 0x7005
    TORQUE_LIMIT = 0x700B
    POSITION = 0x7019
    VELOCITY = 0x701B
    VOLTAGE = 0x701C
    CAN_TIMEOUT = 0x7028
    """RobStride only; units of 50 us, 0 = off, which is the factory's setting."""


OPERATION_MODE = 0
"""Value of the run mode parameter: MIT control."""
STOP_DATA = bytes(8)
CLEAR_DATA = b"\x01" + bytes(7)

COMMAND = Struct(">HHHH")
"""Position, velocity, kp, kd; the torque is in the identifier."""
FEEDBACK = Struct(">HHHH")
"""Position, velocity, torque, temperature in 0.1 degC."""
FAULT_REPORT = Struct("<II")
"""Faults, warnings."""
_PARAMETER = Struct("<HH4s")
F32, U32, U8 = Struct("<f"), Struct("<I"), Struct("<B3x")


class Identifier(NamedTuple):
    """A 29-bit identifier, taken apart."""

    type: int
    data: int
    target: int


def pack_id(type_: int, data: int, target: int) -> int:
    """Return the identifier with its flag; `data` is 16 bits, `target` 8."""
    return EFF_FLAG | type_ << 24 | data << 8 | target


def parse_id(can_id: int) -> Identifier | None:
    """Take a 29-bit identifier apart, None for an 11-bit one."""
    if not can_id & EFF_FLAG:
        return None
    return Identifier(can_id >> 24 & 0x1F, can_id >> 8 & 0xFFFF, can_id & 0xFF)


def pack_control(node_id: int, codes: Codes) -> tuple[int, bytes]:
    """Return identifier and payload of a control frame (4.1.2)."""
    data = COMMAND.pack(codes.position, codes.velocity, codes.kp, codes.kd)
    return pack_id(Type.CONTROL, codes.torque, node_id), data


def parse_control(identifier: Identifier, data: bytes) -> Codes | None:
    """Return a control frame's numbers, None if its payload is not 8 bytes."""
    if len(data) != COMMAND.size:
        return None
    position, velocity, kp, kd = COMMAND.unpack(data)
    return Codes(position, velocity, kp, kd, identifier.data)


class Status(NamedTuple):
    """What a reply's identifier says of the drive."""

    node_id: int
    mode: int
    faults: int
    """Bits as in `FAULTS`."""


def feedback_id(status: Status, host_id: int) -> int:
    """Return the identifier of a reply (4.1.3)."""
    return pack_id(Type.FEEDBACK, status.mode << 14 | status.faults << 8 | status.node_id, host_id)


def parse_status(data16: int) -> Status:
    """Return the status in the middle part of a reply's identifier."""
    return Status(data16 & 0xFF, data16 >> 14, data16 >> 8 & 0x3F)


def fault_names(bits: int, names: dict[int, str]) -> str:
    """Return the names of the bits set, unnamed ones by number."""
    each = [names.get(bit, f"bit {bit}") for bit in range(32) if bits >> bit & 1]
    return ", ".join(each)


def pack_parameter(index: int, raw: bytes = b"\0\0\0\0") -> bytes:
    """Payload of a parameter read, its answer, or a write (4.1.8, 4.1.9); `raw` is 4 bytes."""
    return _PARAMETER.pack(index, 0, raw)


def parse_parameter(data: bytes) -> tuple[int, bytes] | None:
    """Return (index, value as 4 bytes), None if the payload is not 8 bytes."""
    if len(data) != _PARAMETER.size:
        return None
    index, _, raw = _PARAMETER.unpack(data)
    return index, raw
