"""The frame that asks an emulator for a fault. No real amplifier is ever sent one.

Data: target u8, kind u8, joint u8 (from 1; 0 = all), 1 byte unused, duration u32 in ms (0 = until
cleared by kind `ok`).
"""

import struct
from enum import IntEnum
from typing import Final, NamedTuple

from drivers.frame import EFF_FLAG, pack_frame

FAULT_ID: Final = EFF_FLAG | 0x1FFF_FFF1
"""Neighbour of `drivers.frame.LOCKSTEP_ID`; emulators listen to it, amplifiers do not."""
_LAYOUT: Final = struct.Struct("<BBBxI")
DURATION_MAX_S: Final = 3600.0


class FaultTarget(IntEnum):
    """What has the fault."""

    ENCODER = 0
    AMPLIFIER = 1
    BUS = 2
    HOST = 3

    @property
    def has_joints(self) -> bool:
        """There is one per joint."""
        return self <= FaultTarget.AMPLIFIER


class FaultKind(IntEnum):
    """What is wrong with it; `sim_backend.faults` says what each means where."""

    OK = 0
    OFF = 1
    STUCK = 2
    GARBAGE = 3
    WRONG = 4
    SLOW = 5
    DELAYED = 6
    INTERMITTENT = 7


class FaultOrder(NamedTuple):
    """What a fault frame asks for; `joint` 0 is all, `duration_ms` 0 is until cleared."""

    target: FaultTarget
    kind: FaultKind
    joint: int = 0
    duration_ms: int = 0


def pack_fault(order: FaultOrder) -> bytes:
    """Build the frame record.

    Raises:
        ValueError: If joint or duration does not fit.
    """
    if not (0 <= order.joint <= 0xFF and 0 <= order.duration_ms <= 0xFFFF_FFFF):
        raise ValueError(f"joint {order.joint}, duration {order.duration_ms} ms do not fit")
    return pack_frame(FAULT_ID, _LAYOUT.pack(*order))


def parse_fault(data: bytes) -> FaultOrder | None:
    """Read the frame's data; None if it is nothing that `pack_fault` writes."""
    if len(data) != _LAYOUT.size:
        return None
    target, kind, joint, duration_ms = _LAYOUT.unpack(data)
    try:
        return FaultOrder(FaultTarget(target), FaultKind(kind), joint, duration_ms)
    except ValueError:
        return None
