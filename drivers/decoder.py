"""Frames in words: what is in them by name, and their bytes as `candump` writes them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from drivers.database import arm_database, axis_signals, message_key
from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_FLAG,
    FD_FLAGS_INDEX,
    LOCKSTEP_ID,
    RTR_FLAG,
    is_fd,
    unpack_frame,
)
from drivers.settings import AxisSettings

if TYPE_CHECKING:
    from cantools.database.can import Signal

_WIDE_BITS = 16
"""Integers without a unit are shown in hexadecimal from this width on."""


class DecodedFrame(NamedTuple):
    """One frame by name. Values with names in the DBC are text, others numbers in its units."""

    name: str
    values: Mapping[str, float | str]
    text: str


class FrameDecoder:
    """Decodes records from one of an arm's buses by its database. Bytes from it never raise.

    Raises:
        DatabaseError: If cantools is not installed.
    """

    def __init__(self, axes: Sequence[AxisSettings], bus: int = 1) -> None:
        database = arm_database(axes, bus)
        from cantools.database.errors import Error

        self._failures = (Error, ValueError, KeyError)
        self._payloads = _payloads(axes)
        self._messages = {message_key(message): message for message in database.messages}

    def decode(self, frame: bytes) -> DecodedFrame | None:
        """Return a frame by name; None if no message has its identifier or its bytes do not fit."""
        can_id, data = unpack_frame(frame)
        message = self._messages.get(can_id)
        if message is None or len(data) < message.length:
            return None
        if (message.name, data) in self._payloads:
            return DecodedFrame(message.name, {}, self._payloads[message.name, data])
        try:
            decoded = message.decode(data) if message.signals else {}
        except self._failures:
            return None
        if not isinstance(decoded, dict):
            return None
        values = {
            key: value if isinstance(value, int | float) else str(value)
            for key, value in decoded.items()
        }
        words = [_word(signal, values) for signal in message.signals]
        return DecodedFrame(message.name, values, " ".join(word for word in words if word))

    def describe(self, frame: bytes) -> str:
        """Return what a frame is in one line; empty if it cannot be told."""
        decoded = self.decode(frame)
        if decoded is not None:
            return f"{decoded.name} {decoded.text}".rstrip()
        can_id, data = unpack_frame(frame)
        if can_id == LOCKSTEP_ID:
            return "emulated time: one period"
        if can_id & ERR_FLAG:
            return "error report of the CAN controller"
        asked = self._messages.get(can_id & ~RTR_FLAG)
        is_request = bool(can_id & RTR_FLAG) or not data
        return f"{asked.name} requested" if is_request and asked is not None else ""


def _payloads(axes: Sequence[AxisSettings]) -> Mapping[tuple[str, bytes], str]:
    return {
        (f"J{joint}_{message}", data): text
        for joint, axis in enumerate(axes, start=1)
        if (known := axis_signals(axis)) is not None
        for (message, data), text in known.payloads.items()
    }


def frame_label(frame: bytes) -> str:
    """Return identifier and bytes as `candump` writes them: `181#3712...`; CAN FD: `100##1...`."""
    can_id, data = unpack_frame(frame)
    is_wide = can_id & (EFF_FLAG | ERR_FLAG)
    number = can_id & (EFF_MASK | ERR_FLAG)
    shown = f"{number:08X}" if is_wide else f"{number:03X}"
    if can_id & RTR_FLAG:
        return f"{shown}#R"
    mark = f"##{frame[FD_FLAGS_INDEX] & 0xF:X}" if is_fd(frame) else "#"
    return f"{shown}{mark}{data.hex().upper()}"


def _word(signal: Signal, values: Mapping[str, float | str]) -> str:
    """Return `Name=value unit`; of a flag only its name, and nothing if it is not set."""
    value = values.get(signal.name)
    if value is None:
        return ""
    if signal.length == 1 and not isinstance(value, str):
        return signal.name if value else ""
    if isinstance(value, str):
        shown = f"'{value}'" if " " in value else value
    elif isinstance(value, int) and not signal.unit and signal.length >= _WIDE_BITS:
        shown = f"0x{value & (1 << signal.length) - 1:0{signal.length // 4}X}"
    else:
        shown = f"{value:.6g}" if isinstance(value, float) else f"{value}"
    return f"{signal.name}={shown}{' ' + signal.unit if signal.unit else ''}"
