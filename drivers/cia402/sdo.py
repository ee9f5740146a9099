"""SDO frames (CiA 301 v4.2, 7.2.4.3): bytes <-> values, expedited and segmented, no transfer state.

Every SDO frame has 8 bytes. Segmented transfers: the toggle bit starts at 0 and alternates; the
last segment says so. Block transfer is not supported: such frames parse as UNKNOWN.
"""

from dataclasses import dataclass
from enum import Enum, IntEnum
from struct import Struct

_LAYOUT = Struct("<BHB4s")
_LAYOUT_U32 = Struct("<BHBI")
_U32 = Struct("<I")


class SdoAbort(IntEnum):
    """Abort codes (7.2.4.3.17)."""

    TOGGLE = 0x0503_0000
    TIMEOUT = 0x0504_0000
    UNKNOWN_COMMAND = 0x0504_0001
    OUT_OF_MEMORY = 0x0504_0005
    UNSUPPORTED_ACCESS = 0x0601_0000
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    PDO_LENGTH = 0x0604_0042
    INCOMPATIBLE_PARAMETER = 0x0604_0043
    LENGTH = 0x0607_0010
    LENGTH_TOO_HIGH = 0x0607_0012
    LENGTH_TOO_LOW = 0x0607_0013
    NO_SUBINDEX = 0x0609_0011
    VALUE_RANGE = 0x0609_0030
    VALUE_TOO_HIGH = 0x0609_0031
    VALUE_TOO_LOW = 0x0609_0032
    GENERAL = 0x0800_0000
    CANNOT_STORE = 0x0800_0020
    DEVICE_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024

    @property
    def text(self) -> str:
        """The code in words."""
        return _ABORT_TEXT[self]


_ABORT_TEXT = {
    SdoAbort.TOGGLE: "toggle bit not alternated",
    SdoAbort.TIMEOUT: "SDO protocol timed out",
    SdoAbort.UNKNOWN_COMMAND: "command specifier not valid or unknown",
    SdoAbort.OUT_OF_MEMORY: "out of memory",
    SdoAbort.UNSUPPORTED_ACCESS: "unsupported access to an object",
    SdoAbort.WRITE_ONLY: "attempt to read a write-only object",
    SdoAbort.READ_ONLY: "attempt to write a read-only object",
    SdoAbort.NO_OBJECT: "object does not exist",
    SdoAbort.NOT_MAPPABLE: "object cannot be mapped to the PDO",
    SdoAbort.PDO_LENGTH: "mapped objects would exceed the PDO length",
    SdoAbort.INCOMPATIBLE_PARAMETER: "general parameter incompatibility",
    SdoAbort.LENGTH: "data length does not match the object",
    SdoAbort.LENGTH_TOO_HIGH: "data longer than the object",
    SdoAbort.LENGTH_TOO_LOW: "data shorter than the object",
    SdoAbort.NO_SUBINDEX: "subindex does not exist",
    SdoAbort.VALUE_RANGE: "value out of range",
    SdoAbort.VALUE_TOO_HIGH: "value too high",
    SdoAbort.VALUE_TOO_LOW: "value too low",
    SdoAbort.GENERAL: "general error",
    SdoAbort.CANNOT_STORE: "data cannot be transferred or stored",
    SdoAbort.DEVICE_STATE: "data cannot be stored in the present device state",
    SdoAbort.NO_DATA: "no data available",
}


def describe_abort(code: int) -> str:
    """Return an abort code as text for a message, for example `06090030 value out of range`."""
    known = code in _ABORT_TEXT
    return f"{code:08X} {SdoAbort(code).text if known else 'unknown abort code'}"


class SdoKind(Enum):
    """What an SDO frame is; the same names for requests and answers."""

    DOWNLOAD = "initiate download"
    UPLOAD = "initiate upload"
    DOWNLOAD_SEGMENT = "download segment"
    UPLOAD_SEGMENT = "upload segment"
    ABORT = "abort"
    UNKNOWN = "unknown"


@dataclass(frozen=True, slots=True)
class SdoFrame:
    """One parsed SDO frame. Fields that its kind does not carry keep their defaults."""

    kind: SdoKind
    index: int = 0
    subindex: int = 0
    data: bytes = b""
    """Expedited data, or the bytes of a segment."""
    is_expedited: bool = False
    size: int | None = None
    """Announced length of the whole value, None if it was not announced."""
    toggle: int = 0
    """0 or 1."""
    is_last: bool = False
    abort_code: int = 0


_REQUESTS = (  # by client command specifier
    SdoKind.DOWNLOAD_SEGMENT,
    SdoKind.DOWNLOAD,
    SdoKind.UPLOAD,
    SdoKind.UPLOAD_SEGMENT,
    SdoKind.ABORT,
)
_ANSWERS = (  # by server command specifier
    SdoKind.UPLOAD_SEGMENT,
    SdoKind.DOWNLOAD_SEGMENT,
    SdoKind.UPLOAD,
    SdoKind.DOWNLOAD,
    SdoKind.ABORT,
)


def _initiate(specifier: int, index: int, subindex: int, data: bytes) -> bytes:
    if 1 <= len(data) <= 4:  # expedited
        command = specifier << 5 | 4 - len(data) << 2 | 0b11
        return _LAYOUT.pack(command, index, subindex, data)
    return _LAYOUT_U32.pack(specifier << 5 | 0b01, index, subindex, len(data))


def _segment(toggle: int, data: bytes, is_last: bool) -> bytes:
    command = toggle << 4 | 7 - len(data) << 1 | is_last
    return bytes((command,)) + data.ljust(7, b"\0")


def sdo_download_request(index: int, subindex: int, data: bytes) -> bytes:
    """Write 1 to 4 bytes at once, or announce a segmented download of `len(data)` bytes."""
    return _initiate(1, index, subindex, data)


def sdo_download_segment_request(toggle: int, data: bytes, *, is_last: bool) -> bytes:
    """Send up to 7 bytes of a segmented download; the first toggle is 0."""
    return _segment(toggle, data, is_last)


def sdo_upload_request(index: int, subindex: int) -> bytes:
    """Ask for the value of an object."""
    return _LAYOUT_U32.pack(2 << 5, index, subindex, 0)


def sdo_upload_segment_request(toggle: int) -> bytes:
    """Ask for the next segment; the first toggle is 0."""
    return bytes((3 << 5 | toggle << 4,)).ljust(8, b"\0")


def sdo_download_response(index: int, subindex: int) -> bytes:
    """Confirm a download, or accept the announced segments."""
    return _LAYOUT_U32.pack(3 << 5, index, subindex, 0)


def sdo_download_segment_response(toggle: int) -> bytes:
    """Confirm one download segment."""
    return bytes((1 << 5 | toggle << 4,)).ljust(8, b"\0")


def sdo_upload_response(index: int, subindex: int, data: bytes) -> bytes:
    """Answer with 1 to 4 bytes at once, or announce `len(data)` bytes in segments."""
    return _initiate(2, index, subindex, data)


def sdo_upload_segment_response(toggle: int, data: bytes, *, is_last: bool) -> bytes:
    """Answer with the next up to 7 bytes."""
    return _segment(toggle, data, is_last)


def sdo_abort(index: int, subindex: int, code: int) -> bytes:
    """End a transfer, from either side."""
    return _LAYOUT_U32.pack(4 << 5, index, subindex, code)


def parse_sdo_request(data: bytes) -> SdoFrame | None:
    """Parse what a client sent (0x600 + node). None unless it is 8 bytes long."""
    return _parse_sdo(data, _REQUESTS)


def parse_sdo_response(data: bytes) -> SdoFrame | None:
    """Parse what a server sent (0x580 + node). None unless it is 8 bytes long."""
    return _parse_sdo(data, _ANSWERS)


def _parse_sdo(frame: bytes, kinds: tuple[SdoKind, ...]) -> SdoFrame | None:
    if len(frame) != _LAYOUT.size:
        return None
    command, index, subindex, data = _LAYOUT.unpack(frame)
    specifier = command >> 5
    kind = kinds[specifier] if specifier < len(kinds) else SdoKind.UNKNOWN
    if specifier == 0:  # the one kind that carries segment data, in either direction
        used = 7 - (command >> 1 & 0b111)
        return SdoFrame(
            kind, data=frame[1 : 1 + used], toggle=command >> 4 & 1, is_last=bool(command & 1)
        )
    if kind in (SdoKind.DOWNLOAD_SEGMENT, SdoKind.UPLOAD_SEGMENT):
        return SdoFrame(kind, toggle=command >> 4 & 1)
    (number,) = _U32.unpack(data)
    if kind is SdoKind.ABORT:
        return SdoFrame(kind, index, subindex, abort_code=number)
    has_size = command & 0b01
    if not command & 0b10:
        return SdoFrame(kind, index, subindex, size=number if has_size else None)
    used = 4 - (command >> 2 & 0b11) if has_size else 4
    size = used if has_size else None
    return SdoFrame(kind, index, subindex, data=data[:used], is_expedited=True, size=size)
