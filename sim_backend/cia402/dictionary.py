"""The object dictionary at run time: values behind index and subindex, with access checks."""

from collections.abc import Callable
from struct import Struct
from typing import NamedTuple

from drivers.cia402.sdo import SdoAbort
from sim_backend.cia402.objects import ENTRIES, FORMATS, Entry

Read = Callable[[], int | None]
"""Gives a live value; None means there is none at present."""
Write = Callable[[int], SdoAbort | None]
"""Takes a value over, or says why not; then nothing has changed."""

COMMUNICATION_AREA = range(0x1000, 0x2000)


def key_of(index: int, subindex: int) -> int:
    """Return the one number that stands for index and subindex."""
    return index << 8 | subindex


class _Slot(NamedTuple):
    entry: Entry
    layout: Struct


_SLOTS = {
    key_of(entry.index, entry.subindex): _Slot(entry, Struct("<" + FORMATS[entry.data_type]))
    for entry in ENTRIES
    if entry.data_type in FORMATS
}
_STRINGS = {
    key_of(entry.index, entry.subindex): entry.default.encode()
    for entry in ENTRIES
    if isinstance(entry.default, str)
}
"""Constant strings."""
_INDICES = frozenset(entry.index for entry in ENTRIES)


def find_entry(index: int, subindex: int) -> Entry | SdoAbort:
    """Return a numeric entry, or the abort code that says what does not exist."""
    slot = _SLOTS.get(key_of(index, subindex))
    return _missing(index) if slot is None else slot.entry


def _missing(index: int) -> SdoAbort:
    return SdoAbort.NO_SUBINDEX if index in _INDICES else SdoAbort.NO_OBJECT


class ObjectDictionary:
    """Values of one drive.

    Attributes:
        values: Stored numbers by `key_of(index, subindex)`; live objects are not among them.
    """

    __slots__ = ("_defaults", "_read", "_write", "values")

    def __init__(self, node_id: int, fixed: dict[int, int]) -> None:
        """Build it with `fixed` values (by key) for entries whose default the table leaves open."""
        self._defaults = {
            key: slot.entry.default + node_id * slot.entry.is_node_relative
            for key, slot in _SLOTS.items()
            if isinstance(slot.entry.default, int)
        } | fixed
        self._read: dict[int, Read] = {}
        self._write: dict[int, Write] = {}
        self.values = dict(self._defaults)

    def bind(
        self, index: int, subindex: int = 0, *, read: Read | None = None, write: Write | None = None
    ) -> None:
        """Put live behaviour behind an entry. A bound write stores the value itself, if need be."""
        if read is not None:
            self._read[key_of(index, subindex)] = read
        if write is not None:
            self._write[key_of(index, subindex)] = write

    def restore(self, area: range) -> None:
        """Set the stored values of an index range to their power-on values."""
        for key, value in self._defaults.items():
            if key >> 8 in area:
                self.values[key] = value

    def getter(self, index: int, subindex: int) -> Read:
        """Return what reads an entry fast, for a TPDO."""
        key = key_of(index, subindex)
        values = self.values
        return self._read.get(key) or (lambda: values[key])

    def setter(self, index: int, subindex: int) -> Callable[[int], object]:
        """Return what writes an entry fast, for an RPDO."""
        key = key_of(index, subindex)
        return self._write.get(key) or (lambda value: self.values.__setitem__(key, value))

    def upload(self, index: int, subindex: int) -> bytes | SdoAbort:
        """Return an entry's bytes for an SDO client, or the reason why not."""
        key = key_of(index, subindex)
        if key in _STRINGS:
            return _STRINGS[key]
        if key not in _SLOTS:
            return _missing(index)
        value = self.getter(index, subindex)()
        return SdoAbort.NO_DATA if value is None else _SLOTS[key].layout.pack(value)

    def check_download(self, index: int, subindex: int, size: int | None) -> SdoAbort | None:
        """Say why a value of `size` bytes (None: not announced) may not be written, if so."""
        key = key_of(index, subindex)
        if key in _STRINGS:
            return SdoAbort.READ_ONLY
        if key not in _SLOTS:
            return _missing(index)
        entry, layout = _SLOTS[key]
        if entry.access != "rw":
            return SdoAbort.READ_ONLY
        if size is None or size == layout.size:
            return None
        return SdoAbort.LENGTH_TOO_HIGH if size > layout.size else SdoAbort.LENGTH_TOO_LOW

    def download(self, index: int, subindex: int, data: bytes) -> SdoAbort | None:
        """Write an entry for an SDO client, or return the reason why not."""
        refusal = self.check_download(index, subindex, len(data))
        if refusal is not None:
            return refusal
        key = key_of(index, subindex)
        entry, layout = _SLOTS[key]
        value: int = layout.unpack(data)[0]
        is_low = entry.low is not None and value < entry.low
        if is_low or (entry.high is not None and value > entry.high):
            return SdoAbort.VALUE_RANGE
        write = self._write.get(key)
        if write is not None:
            return write(value)
        self.values[key] = value
        return None

    def size_of(self, index: int, subindex: int) -> int:
        """Return an existing numeric entry's size in bytes."""
        return _SLOTS[key_of(index, subindex)].layout.size
