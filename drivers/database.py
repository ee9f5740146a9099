"""What is in a frame, by name: the families' DBC files, put together for one arm.

A family ships a DBC file in its folder, for one node and in the amplifier's raw units, as
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
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

from drivers.errors import DriverError
from drivers.frame import EFF_FLAG
from drivers.settings import AxisSettings

if TYPE_CHECKING:
    from cantools.database.can import Database, Message, Signal

_FAMILIES = {  # family -> module whose `signals(settings)` returns `AxisSignals`
    "cia402": "drivers.cia402.signals",
    "mit": "drivers.mit.signals",
    "odrive": "drivers.odrive.signals",
}


class DatabaseError(DriverError):
    """Frames cannot be decoded by name; the message says what is missing."""


class Scale(NamedTuple):
    """Physical value = raw value * factor + offset."""

    factor: float
    offset: float
    unit: str


class AxisSignals(NamedTuple):
    """How one configured axis speaks the frames of its family's DBC file."""

    dbc: str
    """File in the family's folder."""
    scales: Mapping[str, Scale]
    """By signal."""
    ids: Mapping[str, int] = MappingProxyType({})
    """Identifiers that do not follow from the node, by message."""
    payloads: Mapping[tuple[str, bytes], str] = MappingProxyType({})
    """(message, data) that mean something else than the signals say -> what."""


def axis_signals(axis: AxisSettings) -> AxisSignals | None:
    """Return what is known of an axis's frames, None if no DBC file can describe them."""
    module = _FAMILIES.get(str(getattr(axis, "family", "")))
    found: AxisSignals | None = import_module(module).signals(axis) if module else None
    return found


def dbc_path(axis: AxisSettings) -> Path | None:
    """Return the DBC file of an axis's family as shipped, None if it has none."""
    known = axis_signals(axis)
    if known is None:
        return None
    folder = _FAMILIES[str(getattr(axis, "family", ""))].split(".")[1]
    return Path(__file__).parent / folder / known.dbc


def arm_database(axes: Sequence[AxisSettings], bus: int = 1) -> Database:
    """Put together the frames of an arm, each axis under its own identifiers and in SI units.

    Args:
        axes: Settings of the axes, shoulder first; messages of the first are named `J1_...`.
            Families without a DBC file are left out.
        bus: Number of the bus; axes on others are left out, and keep their numbers.

    Raises:
        DatabaseError: If cantools is not installed.
    """
    _require_cantools()
    from cantools.database.can import Database, Node

    messages: dict[int, Message] = {}
    joints = [(f"J{joint}", a) for joint, a in enumerate(axes, start=1) if a.bus == bus]
    for name, axis in joints:
        for message in _axis_messages(axis, name):
            messages.setdefault(message_key(message), message)
    names = ["Master", *(name for name, _ in joints)]
    nodes = [Node(name) for name in names]
    return Database(messages=list(messages.values()), nodes=nodes, version="")


def _require_cantools() -> None:
    if find_spec("cantools") is None:
        raise DatabaseError(
            "decoding frames needs cantools: pip install 'hil[bus]', or ask for raw frames"
        )


def message_key(message: Message) -> int:
    """Return a message's identifier as records have it, with `EFF_FLAG` if it has 29 bits."""
    return message.frame_id | (EFF_FLAG if message.is_extended_frame else 0)


@lru_cache(maxsize=8)
def _load(path: Path) -> Database:
    from cantools.database.can import Database

    database = Database()
    database.add_dbc_file(str(path))
    return database


def _axis_messages(axis: AxisSettings, name: str) -> Iterable[Message]:
    """Yield the family's messages for one axis; those for all nodes keep their names."""
    known, path = axis_signals(axis), dbc_path(axis)
    if known is None or path is None:
        return
    database = _load(path)
    base = _attribute(database.dbc, "BaseNode")
    for message in database.messages:
        step = _attribute(message.dbc, "NodeStep")
        can_id = known.ids.get(message.name, message.frame_id + step * (axis.node - base))
        yield _moved(message, can_id, name if step else "", known.scales)


def _attribute(specifics: object, name: str) -> int:
    attributes = getattr(specifics, "attributes", None) or {}
    found = attributes.get(name)
    return int(found.value) if found is not None else 0


def _moved(message: Message, can_id: int, axis: str, scales: Mapping[str, Scale]) -> Message:
    """Return a message under the axis's own identifier and name, its signals scaled."""
    from cantools.database.can import Message

    return Message(
        frame_id=can_id,
        name=f"{axis}_{message.name}" if axis else message.name,
        length=message.length,
        signals=[_scaled(signal, scales.get(signal.name)) for signal in message.signals],
        comment=message.comment,
        senders=[axis if axis and "Master" not in message.senders else "Master"],
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
