"""The bus interface and its registry: one address line selects a back-end.

Addresses: `unix:PATH`, `socketcan:IFACE` (short `vcan0`, `can0`), `slcan:DEVICE[@BITRATE]`,
`python-can:INTERFACE:CHANNEL[@BITRATE]`.
Back-ends are imported when first used, so that a missing optional library only matters to
those who ask for it.
"""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from importlib import import_module
from types import TracebackType
from typing import Self

from drivers.errors import BusAddressError


@dataclass(slots=True)
class BusStats:
    """Counters since the bus was opened."""

    frames_sent: int = 0
    frames_received: int = 0
    """Frames from other participants, without the controller's error reports."""
    send_failures: int = 0
    """Frames the back-end could not take (queue full): lost, counted, never retried in a cycle."""
    error_frames: int = 0
    """Error reports received (`ERR_FLAG`)."""
    receive_overflows: int = 0
    """Frames the kernel dropped because nobody read them in time, where the back-end can tell."""
    malformed_records: int = 0
    """Records that are no CAN frame, or none this bus carries: dropped, never raised."""


class Bus(ABC):
    """One participant on one CAN bus. Frames are records (`drivers.frame`).

    Attributes:
        carries_fd: CAN FD frames can be sent and received; elsewhere one that is sent is lost.
    """

    carries_fd = True

    def __init__(self) -> None:
        self.stats = BusStats()

    @abstractmethod
    def send(self, frame: bytes) -> bool:
        """Queue one frame for transmission without blocking.

        Returns:
            False if the queue is full: the frame is lost and counted in `stats.send_failures`.

        Raises:
            BusError: If the bus is gone (interface down, hub closed). Nothing was sent.
        """

    @abstractmethod
    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame from another participant, waiting at most `timeout_s`.

        Args:
            timeout_s: 0 polls. Resolution is microseconds, not milliseconds.

        Returns:
            The record, or None when the time is up. Error reports carry `ERR_FLAG`.

        Raises:
            BusError: If the bus is gone.
        """

    def accept(self, can_ids: Collection[int] | None) -> None:  # noqa: B027 - optional
        """Have `recv` return only frames with these identifiers, and error reports.

        For back-ends where this spares the process the others (filters of the kernel); elsewhere
        it does nothing, and all frames keep coming.

        Args:
            can_ids: Identifiers with flags; None = all.

        Raises:
            BusError: If the bus is gone.
        """

    def _count_error_report(self) -> None:
        """Book the frame just counted as received as an error report instead."""
        self.stats.frames_received -= 1
        self.stats.error_frames += 1

    @abstractmethod
    def fileno(self) -> int:
        """File descriptor that is readable when `recv(0)` would return a frame, or -1."""

    @abstractmethod
    def close(self) -> None:
        """Leave the bus. Idempotent."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


_BACKENDS = {  # scheme -> "module:class"; the class takes the rest of the address
    "unix": "drivers.buses.unix:UnixBus",
    "socketcan": "drivers.buses.socketcan:SocketCanBus",
    "slcan": "drivers.buses.slcan:SlcanBus",
    "python-can": "drivers.buses.python_can:PythonCanBus",
}


def split_address(address: str) -> tuple[str, str]:
    """Split a bus address into (scheme, rest), expanding the short form `vcan0`.

    Raises:
        BusAddressError: If the scheme is unknown or the rest is empty.
    """
    scheme, colon, rest = address.partition(":")
    if not colon:
        scheme, rest = "socketcan", address
    if scheme not in _BACKENDS or not rest:
        forms = (
            "unix:PATH, socketcan:IFACE (or just IFACE), slcan:DEVICE[@BITRATE], "
            "python-can:INTERFACE:CHANNEL[@BITRATE]"
        )
        raise BusAddressError(f"bus address {address!r} is not one of: {forms}")
    return scheme, rest


def open_bus(address: str) -> Bus:
    """Join the bus at `address`.

    Raises:
        BusAddressError: If the address cannot be understood.
        BusError: If the bus is not there or may not be used.
    """
    scheme, rest = split_address(address)
    module, _, name = _BACKENDS[scheme].partition(":")
    bus: Bus = getattr(import_module(module), name)(rest)
    return bus
