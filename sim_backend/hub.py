"""The emulator's side of a bus: it listens on the Unix bus, or joins any other one.

On the Unix bus the emulator is the wire. What one client sends goes to all other clients and to
the emulator; what the emulator sends goes to all clients.
"""

import fcntl
import os
import select
import socket
import stat
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from types import TracebackType
from typing import Self

from drivers.bus import Bus, open_bus, split_address
from drivers.buses.unix import RECORD_LIMIT, enlarge_send_queue, is_hung_up
from drivers.errors import BusError
from drivers.frame import FRAME_SIZE
from sim_backend.errors import SimError

_BATCH = 64  # frames read from one client before the next one has its turn
_BACKLOG = 16
_MODE = 0o660


class Wire(ABC):
    """What the emulated amplifiers are connected to."""

    @abstractmethod
    def transmit(self, frame: bytes) -> None:
        """Put one 16-byte record on the wire without blocking.

        Raises:
            SimError: If the wire is gone.
        """

    @abstractmethod
    def wait(self, timeout_s: float) -> list[bytes]:
        """Return the frames that have arrived, oldest first, waiting for the first one.

        Args:
            timeout_s: Longest wait for the first frame; 0 polls. Resolution is microseconds.

        Returns:
            All frames at hand, at least one unless the time is up.

        Raises:
            SimError: If the wire is gone.
        """

    @abstractmethod
    def close(self) -> None:
        """Leave the wire. Idempotent."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def open_wire(address: str) -> Wire:
    """Open the emulator's side of the bus at `address` (`drivers.bus` lists the forms).

    Raises:
        BusAddressError: If the address cannot be understood.
        SimError: If the bus is not there, or another emulator is.
    """
    scheme, rest = split_address(address)
    if scheme == "unix":
        return UnixHub(rest)
    try:
        return BusWire(open_bus(address))
    except BusError as error:
        raise SimError(str(error)) from error


class BusWire(Wire):
    """A participant on a bus whose wire is elsewhere: SocketCAN, python-can."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def transmit(self, frame: bytes) -> None:
        """Send one frame; a full queue loses it, counted in the bus's `stats`."""
        try:
            self._bus.send(frame)
        except BusError as error:
            raise SimError(str(error)) from error

    def wait(self, timeout_s: float) -> list[bytes]:
        """See `Wire.wait`."""
        frames: list[bytes] = []
        recv = self._bus.recv
        try:
            frame = recv(timeout_s)
            while frame is not None:
                frames.append(frame)
                frame = recv(0.0) if len(frames) < _BATCH else None
        except BusError as error:
            raise SimError(str(error)) from error
        return frames

    def close(self) -> None:
        """Close the bus."""
        self._bus.close()


@dataclass(slots=True)
class ClientStats:
    """Counters of one client of the hub since it connected."""

    frames_received: int = 0
    frames_lost: int = 0
    """Frames not delivered to this client because its queue was full."""
    malformed_records: int = 0
    """Records from this client that are no frame: dropped."""


class _Client:
    __slots__ = ("endpoint", "fd", "recv", "send", "stats")

    def __init__(self, endpoint: socket.socket) -> None:
        self.endpoint = endpoint
        self.fd = endpoint.fileno()
        self.send = endpoint.send
        self.recv = endpoint.recv
        self.stats = ClientStats()

    def put(self, frame: bytes) -> None:
        """Queue one frame for the client; never blocks, never raises."""
        try:
            self.send(frame)
        except BlockingIOError:
            self.stats.frames_lost += 1
        except OSError:
            pass  # it has gone; `wait` reads what it left behind, then drops it

    def take(self) -> tuple[list[bytes], bool]:
        """Return the frames at hand, and whether the client is still there."""
        frames: list[bytes] = []
        is_there = True
        try:
            for _ in range(_BATCH):
                record = self.recv(RECORD_LIMIT)
                if len(record) == FRAME_SIZE:
                    frames.append(record)
                elif not record and is_hung_up(self.endpoint):
                    is_there = False
                    break
                else:
                    self.stats.malformed_records += 1
        except BlockingIOError:
            pass
        except OSError:
            pass  # left with frames unread: its own last frames still come with the next read
        self.stats.frames_received += len(frames)
        return frames, is_there


class UnixHub(Wire):
    """The wire itself, listening at a socket file for any number of clients.

    A relayed frame reaches the other clients before the emulator acts on it, so that nobody sees
    an answer before its question. A client that does not read loses frames, counted in
    `clients`; it never holds up anybody else.

    Raises:
        SimError: If another emulator listens there, or the socket file cannot be made.
    """

    def __init__(self, path: str) -> None:
        self.path = path
        self._listener = _listen(path)
        self._inode = Path(path).stat().st_ino
        self._listener_fd = self._listener.fileno()
        self._clients: list[_Client] = []
        self._readable = [self._listener_fd]

    @property
    def clients(self) -> list[ClientStats]:
        """Counters of the clients now connected, in the order in which they came."""
        return [client.stats for client in self._clients]

    def transmit(self, frame: bytes) -> None:
        """Send one frame to every client; see `Wire.transmit`."""
        for client in self._clients:
            client.put(frame)

    def wait(self, timeout_s: float) -> list[bytes]:
        """See `Wire.wait`. Clients come and go in here."""
        deadline_s = monotonic() + timeout_s
        while True:
            try:
                ready = select.select(self._readable, (), (), timeout_s)[0]
            except (OSError, ValueError) as error:
                raise SimError(f"the bus at unix:{self.path} is closed") from error
            if not ready:
                return ready
            frames = self._collect(ready)
            timeout_s = deadline_s - monotonic()
            if frames or timeout_s <= 0.0:
                return frames

    def _collect(self, ready: list[int]) -> list[bytes]:
        if ready[0] == self._listener_fd:
            self._accept()
        if len(self._clients) == 1: 
            ...
        return []
