"""What is in a frame, by name: the families' DBC files, put together for one arm, and a decoder.

Each family ships `<family>.dbc` in its folder, for one node and in the amplifier's raw units, as
any DBC tool reads it. Two attributes of ours say how it serves other nodes: the file's `BaseNode`,
and per message `NodeStep`, by which its identifier grows with the node (0: one for all nodes).
Files are read, written and decoded by cantools, which is optional: `pip install 'hil[bus]'`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from drivers.errors import DriverError
from drivers.frame import EFF_FLAG, EFF_MASK, ERR_FLAG, LOCKSTEP_ID, RTR_FLAG, unpack_frame
from drivers.settings import AxisSettings

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

_PACKAGES = {  # family -> its folder: FAMILY.dbc, and scales.py if it has physical units
    "cia402": "drivers.cia402",
}
_WIDE_BITS = 16
"""Integers without a unit are shown in hexadecimal from this width on."""


class DatabaseError(DriverError):
    """Frames cannot be decoded by name; the message says what is missing."""


class Scale(NamedTuple):
    """Physical value = raw value * factor + offset."""

    factor: float
    offset: float
    unit: str


def dbc_path(family: str) -> Path | None:
    """Return the family's DBC file as shipped, None if it has none."""
    package = _PACKAGES.get(family)
    if package is None:
        return None
    path = Path(__file__).parent.joinpath(*package.split(".")[1:], f"{family}.dbc")
    return path if path.is_file() else None


def arm_database(axes: Sequence[AxisSettings]) -> Database:
    """Put together the frames of an arm, each axis under its own identifiers and in SI units.

    Args:
        axes: Settings of the axes, shoulder first; messages of the first are named `J1_...`.
            Families without a DBC file are left out.

    Raises:
        DatabaseError: If cantools is not installed.
    """
    _require_cantools()
    from cantools.database.can import Database, Node

    messages: dict[int, Message] = {}
    for joint, axis in enumerate(axes, start=1):
        for message in _axis_messages(axis, f"J{joint}"):
            messages.setdefault(_identifier(message), message)
    names = ["Master", *(f"J{joint}" for joint in range(1, len(axes) + 1))]
    nodes = [Node(name) for name in names]
    return Database(messages=list(messages.values()), nodes=nodes, version="")


def _require_cantools() -> None:
    if find_spec("cantools") is None:
        raise DatabaseError(
            "decoding frames needs cantools: pip install 'hil[bus]', or ask for raw frames"
        )


def _identifier(message: Message) -> int:
    return message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)


@lru_cache(maxsize=8)
def _load(path: Path) -> Database:
    from cantools.database.can import Database

    database = Database()
    database.add_dbc_file(str(path))
    return database


def _axis_messages(axis: AxisSettings, name: str) -> Iterable[Message]:
    """Yield the family's messages for one axis; those for all nodes keep their names."""
    family = str(getattr(axis, "family", ""))
    path = dbc_path(family)
    if path is None:
        return
    database = _load(path)
    base = _attribute(database.dbc, "BaseNode")
    scales = _scales(family, axis)
    for message in database.messages:
        step = _attribute(message.dbc, "NodeStep")
        yield _moved(message, step * (axis.node - base), name, scales if step else {})


def _attribute(specifics: object, name: str) -> int:
    attributes = getattr(specifics, "attributes", None) or {}
    found = attributes.get(name)
    return int(found.value) if found is not None else 0


def _scales(family: str, axis: AxisSettings) -> Mapping[str, Scale]:
    name = f"{_PACKAGES[family]}.scales"
    if not Path(__file__).parent.parent.joinpath(*name.split(".")).with_suffix(".py").is_file():
        return {}
    scales: Mapping[str, Scale] = import_module(name).signal_scales(axis)
    return scales


def _moved(message: Message, by: int, name: str, scales: Mapping[str, Scale]) -> Message:
    """Return a message under the axis's own identifier and name, its signals scaled."""
    from cantools.database.can import Message

    is_shared = not _attribute(message.dbc, "NodeStep")
    return Message(
        frame_id=message.frame_id + by,
        name=message.name if is_shared else f"{name}_{message.name}",
        length=message.length,
        signals=[_scaled(signal, scales.get(signal.name)) for signal in message.signals],
        comment=message.comment,
        senders=["Master" if "Master" in message.senders else name],
        is_extended_frame=message.is_extended_frame,
        is_fd=message.is_fd,
    )


def _scaled(signal: Signal, scale: Scale | None) -> Signal:
    from cantools.database.can import Signal
    from cantools.database.conversion import BaseConversion

    conversion = signal.conversion
    if scale is not None:
        conversion = BaseConversion.factory(
            scale=scale.factor,
            offset=scale.offset,
            choices=signal.choices,
            is_float=signal.conversion.is_float,
        )
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        byte_order=signal.byte_order,
        is_signed=signal.is_signed,
        conversion=conversion,
        unit=signal.unit if scale is None else scale.unit,
        comment=signal.comment,
        is_multiplexer=signal.is_multiplexer,
        multiplexer_ids=signal.multiplexer_ids,
        multiplexer_signal=signal.multiplexer_signal,
    )


class DecodedFrame(NamedTuple):
    """One frame by name. Values with names in the DBC are text, others numbers in its units."""

    name: str
    values: Mapping[str, float | str]
    text: str


class FrameDecoder:
    """Decodes 16-byte records by an arm's database. Bytes from the wire never raise.

    Raises:
        DatabaseError: If cantools is not installed.
    """

    def __init__(self, axes: Sequence[AxisSettings]) -> None:
        database = arm_database(axes)
        from cantools.database.errors import Error

        self._failures = (Error, ValueError, KeyError)
        self._messages = {_identifier(message): message for message in database.messages}

    def decode(self, frame: bytes) -> DecodedFrame | None:
        """Return a frame by name; None if no message has its identifier or its bytes do not fit."""
        can_id, data = unpack_frame(frame)
        message = None if can_id & (RTR_FLAG | ERR_FLAG) else self._messages.get(can_id)
        if message is None or len(data) < message.length:
            return None
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
        """Return a frame as one line: by name if it can be decoded, and its bytes if not."""
        can_id, data = unpack_frame(frame)
        decoded = self.decode(frame)
        if decoded is not None:
            return f"{decoded.name} {decoded.text}".rstrip()
        if can_id == LOCKSTEP_ID:
            return "emulated time: one period"
        if can_id & ERR_FLAG:
            return f"controller error report {data.hex(' ')}"
        if can_id & RTR_FLAG:
            return "remote request"
        return data.hex(" ").upper() or "no data"


def frame_label(frame: bytes) -> str:
    """Return identifier and bytes as `candump` writes them: `181#3712...`, `1FFFFFF0#`."""
    can_id, data = unpack_frame(frame)
    is_wide = can_id & (EFF_FLAG | ERR_FLAG)
    number = can_id & (EFF_MASK | ERR_FLAG)
    shown = f"{number:08X}" if is_wide else f"{number:03X}"
    return f"{shown}#{'R' if can_id & RTR_FLAG else data.hex().upper()}"


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
