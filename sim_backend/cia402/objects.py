"""The object dictionary as tables: what the drive serves by SDO, and what the EDS says."""

from dataclasses import dataclass
from enum import IntEnum

from drivers.cia402.codec import (
    COB_EMCY,
    COB_RPDO1,
    COB_RPDO2,
    COB_SYNC,
    COB_TPDO1,
    COB_TPDO2,
    CST,
    CST_SUPPORTED,
    PDO_OFF,
    RPDO1_MAP,
    TPDO1_MAP,
    TPDO2_MAP,
    Index,
)
from sim_backend.cia402.emergency import HISTORY_LENGTH

DEVICE_NAME = "hil emulated drive"
PRODUCT_CODE = 0x48494C31  # "HIL1"
REVISION = 0x0001_0000
MAPPING_ENTRIES = 8
"""Objects a PDO can hold."""


class DataType(IntEnum):
    """Data types, by their index in the dictionary (CiA 301, 7.4.1)."""

    INTEGER8 = 0x02
    INTEGER16 = 0x03
    INTEGER32 = 0x04
    UNSIGNED8 = 0x05
    UNSIGNED16 = 0x06
    UNSIGNED32 = 0x07
    VISIBLE_STRING = 0x09


FORMATS = {
    DataType.INTEGER8: "b",
    DataType.INTEGER16: "h",
    DataType.INTEGER32: "i",
    DataType.UNSIGNED8: "B",
    DataType.UNSIGNED16: "H",
    DataType.UNSIGNED32: "I",
}
"""`struct` letters of the numeric types; on the wire they are little-endian."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One entry: what a subindex (or an object without subindices) holds and who may access it."""

    index: int
    subindex: int
    name: str
    data_type: DataType
    access: str
    """ro, rw or const."""
    default: int | str | None = 0
    """None: known only when the drive is built (ratings, encoder)."""
    is_node_relative: bool = False
    """The node-ID is added to `default`."""
    pdo: str = ""
    """Where it may be mapped: `r` RPDO, `t` TPDO."""
    low: int | None = None
    high: int | None = None


_U8, _U16, _U32 = DataType.UNSIGNED8, DataType.UNSIGNED16, DataType.UNSIGNED32
_I8, _I16, _I32 = DataType.INTEGER8, DataType.INTEGER16, DataType.INTEGER32

RECORD, ARRAY = 9, 8
COMPOUND: dict[int, tuple[str, int]] = {
    Index.ERROR_HISTORY: ("Pre-defined error field", ARRAY),
    Index.CONSUMER_HEARTBEAT: ("Consumer heartbeat time", ARRAY),
    Index.IDENTITY: ("Identity object", RECORD),
    Index.RPDO1_PARAMETER: ("RPDO communication parameter 1", RECORD),
    Index.RPDO2_PARAMETER: ("RPDO communication parameter 2", RECORD),
    Index.RPDO1_MAPPING: ("RPDO mapping parameter 1", RECORD),
    Index.RPDO2_MAPPING: ("RPDO mapping parameter 2", RECORD),
    Index.TPDO1_PARAMETER: ("TPDO communication parameter 1", RECORD),
    Index.TPDO2_PARAMETER: ("TPDO communication parameter 2", RECORD),
    Index.TPDO1_MAPPING: ("TPDO mapping parameter 1", RECORD),
    Index.TPDO2_MAPPING: ("TPDO mapping parameter 2", RECORD),
    Index.POSITION_RANGE: ("Position range limit", ARRAY),
    Index.ENCODER_RESOLUTION: ("Position encoder resolution", ARRAY),
    Index.CYCLE_TIME: ("Interpolation time period", RECORD),
}
"""Objects with subindices: name and object code (CiA 301, 7.4.3)."""


def _highest(index: int, count: int, access: str = "const") -> Entry:
    return Entry(index, 0, "Highest sub-index supported", _U8, access, count)


def _pdo_parameter(index: int, cob_id: int, *, is_tpdo: bool) -> tuple[Entry, ...]:
    """Communication parameter (CiA 301, 7.5.2.35 and 7.5.2.37); subindex 4 is reserved there."""
    common = (
        _highest(index, 5),
        Entry(index, 1, "COB-ID used by PDO", _U32, "rw", cob_id, is_node_relative=True),
        Entry(index, 2, "Transmission type", _U8, "rw", 1),
    )
    inhibit = (Entry(index, 3, "Inhibit time, 100 us", _U16, "rw"),) if is_tpdo else ()
    return (*common, *inhibit, Entry(index, 5, "Event timer, ms", _U16, "rw"))


def _pdo_mapping(index: int, words: tuple[int, ...]) -> tuple[Entry, ...]:
    """Mapping parameter (CiA 301, 7.5.2.36 and 7.5.2.38)."""
    filled = words + (0,) * (MAPPING_ENTRIES - len(words))
    count = Entry(index, 0, "Number of mapped objects", _U8, "rw", len(words))
    return count, *(
        Entry(index, sub, f"Mapped object {sub}", _U32, "rw", word)
        for sub, word in enumerate(filled, start=1)
    )


_COMMUNICATION = (
    Entry(Index.DEVICE_TYPE, 0, "Device type", _U32, "const", 0x0002_0192),  # servo drive, CiA 402
    Entry(Index.ERROR_REGISTER, 0, "Error register", _U8, "ro", pdo="t"),
    Entry(Index.ERROR_HISTORY, 0, "Number of errors", _U8, "rw"),
    *(
        Entry(Index.ERROR_HISTORY, sub, f"Standard error field {sub}", _U32, "ro", None)
        for sub in range(1, HISTORY_LENGTH + 1)
    ),
    Entry(Index.SYNC_COB_ID, 0, "COB-ID SYNC message", _U32, "const", COB_SYNC),
    Entry(
        Index.DEVICE_NAME,
        0,
        "Manufacturer device name",
        DataType.VISIBLE_STRING,
        "const",
        DEVICE_NAME,
    ),
    Entry(Index.EMCY_COB_ID, 0, "COB-ID EMCY", _U32, "const", COB_EMCY, is_node_relative=True),
    _highest(Index.CONSUMER_HEARTBEAT, 1),
    Entry(Index.CONSUMER_HEARTBEAT, 1, "Node-ID and time, ms", _U32, "rw", high=0x7F_FFFF),
    Entry(Index.PRODUCER_HEARTBEAT, 0, "Producer heartbeat time, ms", _U16, "rw"),
    _highest(Index.IDENTITY, 4),
    Entry(Index.IDENTITY, 1, "Vendor-ID", _U32, "const", 0),  # 0: no CiA vendor id is claimed
    Entry(Index.IDENTITY, 2, "Product code", _U32, "const", PRODUCT_CODE),
    Entry(Index.IDENTITY, 3, "Revision number", _U32, "const", REVISION),
    Entry(Index.IDENTITY, 4, "Serial number", _U32, "const", None),
    *_pdo_parameter(Index.RPDO1_PARAMETER, COB_RPDO1, is_tpdo=False),
    *_pdo_parameter(Index.RPDO2_PARAMETER, COB_RPDO2 | PDO_OFF, is_tpdo=False),
    *_pdo_mapping(Index.RPDO1_MAPPING, RPDO1_MAP),
    *_pdo_mapping(Index.RPDO2_MAPPING, ()),
    *_pdo_parameter(Index.TPDO1_PARAMETER, COB_TPDO1, is_tpdo=True),
    *_pdo_parameter(Index.TPDO2_PARAMETER, COB_TPDO2 | PDO_OFF, is_tpdo=True),
    *_pdo_mapping(Index.TPDO1_MAPPING, TPDO1_MAP),
    *_pdo_mapping(Index.TPDO2_MAPPING, TPDO2_MAP),
)

_MANUFACTURER = (
    Entry(Index.TIME_BASE, 0, "Time base: 0 wall, 1 lockstep", _U8, "const", None),
    Entry(Index.INJECT_FAULT, 0, "Inject fault, EMCY 5000h + value", _U8, "rw"),
)

_PROFILE = (
    Entry(
        Index.ABORT_CONNECTION_OPTION,
        0,
        "Abort connection option code",
        _I16,
        "rw",
        1,
        low=0,
        high=3,
    ),
    Entry(Index.ERROR_CODE, 0, "Error code", _U16, "ro", pdo="t"),
    Entry(Index.CONTROLWORD, 0, "Controlword", _U16, "rw", pdo="r"),
    Entry(Index.STATUSWORD, 0, "Statusword", _U16, "ro", None, pdo="t"),
    Entry(Index.QUICK_STOP_OPTION, 0, "Quick stop option code", _I16, "rw", 2, low=0, high=6),
    Entry(Index.MODE, 0, "Modes of operation", _I8, "rw", pdo="r", low=0, high=CST),
    Entry(Index.MODE_DISPLAY, 0, "Modes of operation display", _I8, "ro", pdo="t"),
    Entry(Index.POSITION_ACTUAL, 0, "Position actual value", _I32, "ro", None, pdo="t"),
    Entry(Index.VELOCITY_ACTUAL, 0, "Velocity actual value", _I32, "ro", None, pdo="t"),
    Entry(Index.TARGET_TORQUE, 0, "Target torque", _I16, "rw", pdo="r"),
    Entry(Index.MAX_TORQUE, 0, "Max torque", _U16, "rw", None, pdo="r"),
    Entry(Index.RATED_CURRENT, 0, "Motor rated current, mA", _U32, "const", None),
    Entry(Index.RATED_TORQUE, 0, "Motor rated torque, mNm", _U32, "const", None),
    Entry(Index.TORQUE_ACTUAL, 0, "Torque actual value", _I16, "ro", None, pdo="t"),
    Entry(Index.CURRENT_ACTUAL, 0, "Current actual value", _I16, "ro", None, pdo="t"),
    _highest(Index.POSITION_RANGE, 2),
    Entry(Index.POSITION_RANGE, 1, "Min position range limit", _I32, "const", 0),
    Entry(Index.POSITION_RANGE, 2, "Max position range limit", _I32, "const", None),
    _highest(Index.ENCODER_RESOLUTION, 2),
    Entry(Index.ENCODER_RESOLUTION, 1, "Encoder increments", _U32, "const", None),
    Entry(Index.ENCODER_RESOLUTION, 2, "Motor revolutions", _U32, "const", 1),
    _highest(Index.CYCLE_TIME, 2),
    Entry(Index.CYCLE_TIME, 1, "Interpolation time period value", _U8, "rw", 1, low=1),
    Entry(Index.CYCLE_TIME, 2, "Interpolation time index", _I8, "rw", -3, low=-6, high=0),
    Entry(Index.SUPPORTED_MODES, 0, "Supported drive modes", _U32, "const", CST_SUPPORTED),
)

ENTRIES: tuple[Entry, ...] = (*_COMMUNICATION, *_MANUFACTURER, *_PROFILE)
"""Every entry, ascending by index and subindex."""
