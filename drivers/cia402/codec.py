"""Bytes <-> values of CiA 301 (CANopen) and CiA 402 (drives): constants and pure functions.

Shared by the master and the emulated drive. Nothing here does I/O, keeps state, or raises for
bytes that came from a wire: a parser returns None for what is not a message of its kind.
SDO frames have a module of their own, `drivers.cia402.sdo`.
Sources: CiA 301 v4.2 (sections are named below), CiA 402-2 / IEC 61800-7-201.
"""

from enum import IntEnum
from struct import Struct
from typing import NamedTuple

# COB-IDs: function code of the predefined connection set (CiA 301, 7.3.5); add the node-ID.
COB_NMT = 0x000
COB_SYNC = 0x080
COB_EMCY = 0x080
COB_TPDO1 = 0x180
COB_RPDO1 = 0x200
COB_TPDO2 = 0x280
COB_RPDO2 = 0x300
COB_SDO_TX = 0x580
"""SDO answers, sent by the drive."""
COB_SDO_RX = 0x600
"""SDO requests, received by the drive."""
COB_HEARTBEAT = 0x700

PDO_OFF = 0x8000_0000
"""Bit 31 of a PDO's COB-ID entry: the PDO does not exist (7.5.2.35, 7.5.2.37)."""
PDO_NO_RTR = 0x4000_0000
"""Bit 30 of a TPDO's COB-ID entry: no remote request allowed."""

CST = 10
"""Mode of operation: cyclic synchronous torque."""
CST_SUPPORTED = 1 << 9
"""Bit of cyclic synchronous torque in 6502."""

U8, U16, U32 = Struct("<B"), Struct("<H"), Struct("<I")
I8, I16, I32 = Struct("<b"), Struct("<h"), Struct("<i")


class Index(IntEnum):
    """Object dictionary indices in use here."""

    DEVICE_TYPE = 0x1000
    ERROR_REGISTER = 0x1001
    ERROR_HISTORY = 0x1003
    SYNC_COB_ID = 0x1005
    DEVICE_NAME = 0x1008
    EMCY_COB_ID = 0x1014
    CONSUMER_HEARTBEAT = 0x1016
    PRODUCER_HEARTBEAT = 0x1017
    IDENTITY = 0x1018
    RPDO1_PARAMETER = 0x1400
    RPDO2_PARAMETER = 0x1401
    RPDO1_MAPPING = 0x1600
    RPDO2_MAPPING = 0x1601
    TPDO1_PARAMETER = 0x1800
    TPDO2_PARAMETER = 0x1801
    TPDO1_MAPPING = 0x1A00
    TPDO2_MAPPING = 0x1A01
    TIME_BASE = 0x2F00  # emulated drive only: u8, 0 wall clock, 1 plant time follows SYNC
    INJECT_FAULT = 0x2F01  # emulated drive only: u8, writing nonzero faults the drive
    ABORT_CONNECTION_OPTION = 0x6007
    ERROR_CODE = 0x603F
    CONTROLWORD = 0x6040
    STATUSWORD = 0x6041
    QUICK_STOP_OPTION = 0x605A
    MODE = 0x6060
    MODE_DISPLAY = 0x6061
    POSITION_ACTUAL = 0x6064
    VELOCITY_ACTUAL = 0x606C
    TARGET_TORQUE = 0x6071
    MAX_TORQUE = 0x6072
    RATED_CURRENT = 0x6075
    RATED_TORQUE = 0x6076
    TORQUE_ACTUAL = 0x6077
    CURRENT_ACTUAL = 0x6078
    POSITION_RANGE = 0x607B
    ENCODER_RESOLUTION = 0x608F
    CYCLE_TIME = 0x60C2
    SUPPORTED_MODES = 0x6502


# --- process data -------------------------------------------------------------------------------

RPDO1 = Struct("<Hh")
"""Controlword 6040, target torque 6071 (per mille of 6076)."""
TPDO1 = Struct("<Hih")
"""Statusword 6041, position 6064 (counts), torque 6077 (per mille of 6076)."""
TPDO2 = Struct("<ih")
"""Velocity 606C (counts/s), current 6078 (per mille of 6075)."""


def mapping_word(index: int, subindex: int, bits: int) -> int:
    """Entry of a PDO mapping object: index, subindex and length (CiA 301, 7.5.2.36)."""
    return index << 16 | subindex << 8 | bits


def split_mapping_word(word: int) -> tuple[int, int, int]:
    """Return (index, subindex, bits) of a PDO mapping entry."""
    return word >> 16 & 0xFFFF, word >> 8 & 0xFF, word & 0xFF


RPDO1_MAP = (
    mapping_word(Index.CONTROLWORD, 0, 16),
    mapping_word(Index.TARGET_TORQUE, 0, 16),
)
TPDO1_MAP = (
    mapping_word(Index.STATUSWORD, 0, 16),
    mapping_word(Index.POSITION_ACTUAL, 0, 32),
    mapping_word(Index.TORQUE_ACTUAL, 0, 16),
)
TPDO2_MAP = (
    mapping_word(Index.VELOCITY_ACTUAL, 0, 32),
    mapping_word(Index.CURRENT_ACTUAL, 0, 16),
)

# --- drive profile ------------------------------------------------------------------------------


class Cia402State(IntEnum):
    """States of the power drive system; the value is the state's statusword pattern."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


STATUS_VOLTAGE_ENABLED = 1 << 4
STATUS_WARNING = 1 << 7
STATUS_REMOTE = 1 << 9
STATUS_INTERNAL_LIMIT = 1 << 11
STATUS_FOLLOWS_COMMAND = 1 << 12
"""In cyclic synchronous torque: the drive follows the target torque."""

CONTROL_DISABLE_VOLTAGE = 0x00
CONTROL_QUICK_STOP = 0x02
CONTROL_SHUTDOWN = 0x06
CONTROL_SWITCH_ON = 0x07
CONTROL_ENABLE_OPERATION = 0x0F
CONTROL_FAULT_RESET = 0x80
"""Acts on the rising edge of bit 7."""


def _state_of(low_bits: int) -> Cia402State:
    for state in Cia402State:
        mask = 0x6F if state & 0x20 or state == Cia402State.QUICK_STOP_ACTIVE else 0x4F
        if low_bits & mask == state:
            return state
    return Cia402State.FAULT if low_bits & 0x08 else Cia402State.NOT_READY_TO_SWITCH_ON


_STATES = tuple(_state_of(low_bits) for low_bits in range(0x80))


def decode_state(statusword: int) -> Cia402State:
    """Return the drive state a statusword (6041) reports.

    The patterns overlap: 07 under mask 6F is quick stop, 0F under mask 4F fault reaction. A
    pattern the standard does not define never reads as powered: FAULT if bit 3 is set, otherwise
    NOT_READY_TO_SWITCH_ON.
    """
    return _STATES[statusword & 0x7F]


# --- network management, heartbeat, emergency ---------------------------------------------------


class NmtCommand(IntEnum):
    """Node control commands (CiA 301, 7.2.8.3.1)."""

    START = 1
    STOP = 2
    ENTER_PRE_OPERATIONAL = 128
    RESET_NODE = 129
    RESET_COMMUNICATION = 130


class NmtState(IntEnum):
    """States as a heartbeat reports them (7.2.8.3.2); 0 is the boot-up message."""

    INITIALISING = 0
    STOPPED = 4
    OPERATIONAL = 5
    PRE_OPERATIONAL = 127


_NMT_COMMANDS = {int(command): command for command in NmtCommand}
_NMT_STATES = {int(state): state for state in NmtState}


def pack_nmt(command: NmtCommand, node_id: int) -> bytes:
    """Payload of a node control message; node 0 addresses all."""
    return bytes((command, node_id))


def parse_nmt(data: bytes) -> tuple[NmtCommand, int] | None:
    """Return (command, node) of a node control message, None if it is not one."""
    if len(data) != 2 or data[0] not in _NMT_COMMANDS:
        return None
    return _NMT_COMMANDS[data[0]], data[1]


def pack_heartbeat(state: NmtState) -> bytes:
    """Payload of a heartbeat, or of the boot-up message for INITIALISING."""
    return bytes((state,))


def parse_heartbeat(data: bytes) -> NmtState | None:
    """Return the state in a heartbeat, None if it is none. Bit 7 (guarding toggle) is ignored."""
    return _NMT_STATES.get(data[0] & 0x7F) if len(data) == 1 else None


def consumer_heartbeat(node_id: int, timeout_ms: int) -> int:
    """Entry of 1016: watch `node_id`, raise 8130 after `timeout_ms` of silence (7.5.2.17)."""
    return node_id << 16 | timeout_ms


class EmcyCode(IntEnum):
    """Emergency error codes in use here (CiA 301, 7.2.7.1)."""

    ERROR_RESET = 0x0000
    HARDWARE = 0x5000
    COMMUNICATION = 0x8100
    HEARTBEAT_LOST = 0x8130
    PDO_LENGTH = 0x8210
    RPDO_TIMEOUT = 0x8250


class Emcy(NamedTuple):
    """One emergency message: error code, error register 1001, five vendor bytes."""

    code: int
    error_register: int
    vendor: bytes


_EMCY = Struct("<HB5s")


def pack_emcy(code: int, error_register: int, vendor: bytes = b"") -> bytes:
    """Payload of an emergency message, always 8 bytes (7.2.7.3)."""
    return _EMCY.pack(code, error_register, vendor)


def parse_emcy(data: bytes) -> Emcy | None:
    """Return an emergency message, None if the payload is not 8 bytes."""
    return Emcy._make(_EMCY.unpack(data)) if len(data) == _EMCY.size else None
