"""What a master may write to a PDO's parameter and mapping objects (CiA 301, 7.5.2.35 to 38)."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar

from drivers.cia402.codec import PDO_NO_RTR, PDO_OFF, split_mapping_word
from drivers.cia402.sdo import SdoAbort
from sim_backend.cia402.dictionary import ObjectDictionary, find_entry, key_of
from sim_backend.cia402.objects import FORMATS, MAPPING_ENTRIES, Entry

PDO_BITS_MAX = 64
SYNCHRONOUS_MAX = 240
EVENT_DRIVEN_MIN = 254
_MAPPING_OFFSET = 0x200  # from a parameter object to its mapping object
_FREE_COB_IDS = (range(0x181, 0x580), range(0x680, 0x6E0))  # 7.3.5: the others are restricted
_BITS = {"b": 8, "B": 8, "h": 16, "H": 16, "i": 32, "I": 32}


class PdoSettings(ABC):
    """One PDO's settings in the object dictionary; refuses what the standard does not allow.

    The order a master has to keep: switch the PDO off (bit 31 of its COB-ID), set the number of
    mapped objects to 0, write the objects, write their number, switch the PDO on.

    Attributes:
        on_change: Called after every accepted change, to compile it.
    """

    direction: ClassVar[str]
    """`r` or `t`, as in `Entry.pdo`."""

    def __init__(self, dictionary: ObjectDictionary, parameter: int) -> None:
        self._dictionary = dictionary
        self._parameter = parameter
        self._mapping = parameter + _MAPPING_OFFSET
        self.on_change: Callable[[], None] = lambda: None
        bind = dictionary.bind
        bind(parameter, 1, write=self._write_cob_id)
        bind(parameter, 2, write=self._write_type)
        bind(parameter, 3, write=self._write_inhibit_time)
        bind(parameter, 5, write=partial(self._store, parameter, 5))
        bind(self._mapping, 0, write=self._write_count)
        for subindex in range(1, MAPPING_ENTRIES + 1):
            bind(self._mapping, subindex, write=partial(self._write_object, subindex))

    @abstractmethod
    def compile(self) -> None:
        """Take over the settings."""

    @abstractmethod
    def forget(self) -> None:
        """Start afresh, as on every change of the NMT state."""

    def _value(self, subindex: int) -> int:
        return self._dictionary.values[key_of(self._parameter, subindex)]

    @property
    def is_on(self) -> bool:
        """The PDO exists: bit 31 of its COB-ID is clear."""
        return not self._value(1) & PDO_OFF

    @property
    def can_id(self) -> int:
        """Its 11-bit identifier."""
        return self._value(1) & 0x7FF

    @property
    def transmission_type(self) -> int:
        """0 to 240 synchronous, 254 and 255 event-driven."""
        return self._value(2)

    @property
    def event_timer_s(self) -> float:
        """RPDO: deadline; TPDO: longest silence. 0 if off."""
        return self._value(5) * 1e-3

    def mapped(self) -> list[Entry]:
        """Return the mapped objects in order."""
        values = self._dictionary.values
        count = values[key_of(self._mapping, 0)]
        words = [values[key_of(self._mapping, sub)] for sub in range(1, count + 1)]
        entries = [find_entry(*split_mapping_word(word)[:2]) for word in words]
        return [entry for entry in entries if isinstance(entry, Entry)]

    # --- checks -------------------------------------------------------------------------------

    def _store(self, index: int, subindex: int, value: int) -> SdoAbort | None:
        self._dictionary.values[key_of(index, subindex)] = value
        self.on_change()
        return None

    def _write_cob_id(self, value: int) -> SdoAbort | None:
        can_id = value & ~(PDO_OFF | PDO_NO_RTR)
        if not any(can_id in free for free in _FREE_COB_IDS):
            return SdoAbort.VALUE_RANGE
        if self.is_on and not value & PDO_OFF and can_id != self.can_id:
            return SdoAbort.DEVICE_STATE
        return self._store(self._parameter, 1, value)

    def _write_type(self, value: int) -> SdoAbort | None:
        if SYNCHRONOUS_MAX < value < EVENT_DRIVEN_MIN:
            return SdoAbort.VALUE_RANGE  # reserved, or remote request, which is not offered
        return self._store(self._parameter, 2, value)

    def _write_inhibit_time(self, value: int) -> SdoAbort | None:
        if self.is_on:
            return SdoAbort.DEVICE_STATE
        return self._store(self._parameter, 3, value)

    def _write_object(self, subindex: int, word: int) -> SdoAbort | None:
        if self.is_on or self._dictionary.values[key_of(self._mapping, 0)]:
            return SdoAbort.DEVICE_STATE
        if word:
            refusal = self._check_object(word)
            if refusal is not None:
                return refusal
        return self._store(self._mapping, subindex, word)

    def _check_object(self, word: int) -> SdoAbort | None:
        index, subindex, bits = split_mapping_word(word)
        entry = find_entry(index, subindex)
        if isinstance(entry, SdoAbort):
            return entry
        has_length = bits == _BITS[FORMATS[entry.data_type]]
        return None if self.direction in entry.pdo and has_length else SdoAbort.NOT_MAPPABLE

    def _write_count(self, count: int) -> SdoAbort | None:
        if self.is_on:
            return SdoAbort.DEVICE_STATE
        if count > MAPPING_ENTRIES:
            return SdoAbort.PDO_LENGTH
        values = self._dictionary.values
        words = [values[key_of(self._mapping, sub)] for sub in range(1, count + 1)]
        if not all(words):
            return SdoAbort.NOT_MAPPABLE
        if sum(split_mapping_word(word)[2] for word in words) > PDO_BITS_MAX:
            return SdoAbort.PDO_LENGTH
        return self._store(self._mapping, 0, count)
