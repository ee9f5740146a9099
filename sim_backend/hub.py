"""The emulator's side of a bus: it listens on the Unix bus or a pty, or joins any other one.

On the Unix bus the emulator is the wire. What one client sends goes to all other clients and to
the emulator; what the emulator sends goes to all clients.
"""

import fcntl
import os
import select
import socket
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from types import TracebackType
from typing import Self

from drivers.bus import Bus, open_bus, split_address
from drivers.buses.unix import RECORD_LIMIT, enlarge_send_queue, is_hung_up
from drivers.errors import BusDownError, BusError
from drivers.frame import RECORD_SIZES
from sim_backend.errors import SimError

_BATCH = 64  # most frames handed over at once
_BACKLOG = 16
_CLIENT_LIMIT = 64  # far below what select() can hold
_MODE = 0o660


class Wire(ABC):
    """What the emulated amplifiers are connected to."""

    address = ""
    """Where to join, if that is not the address which the wire was opened with."""
    bus = 0
    """The bus (from 0) on which the frames that `wait` returned last have come."""

    @abstractmethod
    def transmit(self, frame: bytes) -> None:
        """Put one record (`drivers.frame`) on the wire without blocking.

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

    def filenos(self) -> Sequence[int]:
        """Descriptors one of which is readable when `wait` has something to do; none if unknown."""
        return ()

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
        SimError: If the address cannot be understood, the bus is not there, or another emulator
            is.
    """
    try:
        scheme, rest = split_address(address)
        if scheme == "unix":
            return UnixHub(rest)
        if scheme == "slcan" and rest.replace("=", ",").split(",")[0] == "pty":
            from sim_backend.slcan_wire import SlcanPty

            return SlcanPty(rest)
        return BusWire(open_bus(address))
    except BusError as error:
        raise SimError(str(error)) from error


class BusWire(Wire):
    """A participant on a bus whose wire is elsewhere: SocketCAN, python-can.

    While the bus is down, nothing arrives and what is sent is lost, as for real amplifiers.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus

    def transmit(self, frame: bytes) -> None:
        """Send one frame; a full queue loses it, counted in the bus's `stats`."""
        try:
            self._bus.send(frame)
        except BusDownError:
            pass
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
        except BusDownError:
            sleep(timeout_s)
        except BusError as error:
            raise SimError(str(error)) from error
        return frames

    def filenos(self) -> Sequence[int]:
        """See `Wire.filenos`."""
        number = self._bus.fileno()
        return (number,) if number >= 0 else ()

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
    __slots__ = ("endpoint", "recv", "send", "stats")

    def __init__(self, endpoint: socket.socket) -> None:
        self.endpoint = endpoint
        self.recv = endpoint.recv
        self.send = endpoint.send
        self.stats = ClientStats()

    def put(self, frame: bytes) -> None:
        """Queue one frame for the client; never blocks, never raises."""
        try:
            self.send(frame)
        except OSError:  # full, or gone: `wait` reads what it left behind, then lets it go
            self.stats.frames_lost += 1

    def is_gone(self, record: bytes) -> bool:
        """Judge a record that is no frame: the end of the connection, or something malformed."""
        if not record and is_hung_up(self.endpoint):
            return True
        self.stats.malformed_records += 1
        return False


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
        self._listener = _listen(Path(path))
        self._inode = Path(path).stat().st_ino
        self._clients: dict[int, _Client] = {}
        self._readable = [self._listener.fileno()]  # the listener first: see `_collect`
        self._lost_by_gone = 0

    @property
    def clients(self) -> list[ClientStats]:
        """Counters of the clients now connected, in the order in which they came."""
        return [client.stats for client in self._clients.values()]

    @property
    def frames_lost(self) -> int:
        """Frames that some client did not get, over all clients there have been."""
        return self._lost_by_gone + sum(stats.frames_lost for stats in self.clients)

    def transmit(self, frame: bytes) -> None:
        """Send one frame to every client; see `Wire.transmit`."""
        for client in self._clients.values():
            client.put(frame)

    def wait(self, timeout_s: float) -> list[bytes]:
        """Return one frame from each client that has any; see `Wire.wait`.

        Reading on until nothing is left would delay the first frame by a failing read.
        """
        deadline_s = monotonic() + timeout_s
        while True:
            try:
                ready = select.select(self._readable, (), (), max(0.0, timeout_s))[0]
            except ValueError as error:
                raise SimError(f"the bus at unix:{self.path} is closed") from error
            frames = self._collect(ready)
            timeout_s = deadline_s - monotonic()
            if frames or timeout_s <= 0.0:
                return frames

    def filenos(self) -> Sequence[int]:
        """See `Wire.filenos`."""
        return self._readable

    def _collect(self, ready: list[int]) -> list[bytes]:
        frames: list[bytes] = []
        for fd in ready:
            client = self._clients.get(fd)
            if client is None:  # first, so that a newcomer sees what comes after it
                self._accept()
                continue
            try:
                record = client.recv(RECORD_LIMIT)
            except OSError:
                continue  # it left with frames unread; its own last ones come with the next read
            if len(record) in RECORD_SIZES:
                client.stats.frames_received += 1
                if self._relay(record, client):
                    frames.append(record)
            elif client.is_gone(record):
                self._let_go(fd)
        return frames

    def _relay(self, frame: bytes, sender: _Client) -> bool:
        """Hand a frame to the other clients; True if it is for the emulator at once."""
        for client in self._clients.values():
            if client is not sender:
                client.put(frame)
        return True

    def _accept(self) -> None:
        """Take in all who have connected: nobody who waits here may miss a frame sent later."""
        with suppress(OSError):  # nobody left, or gone again
            while True:
                self._take_in(self._listener.accept()[0])

    def _take_in(self, endpoint: socket.socket) -> None:
        if len(self._clients) >= _CLIENT_LIMIT:
            endpoint.close()
            return
        endpoint.setblocking(False)
        enlarge_send_queue(endpoint)
        client = _Client(endpoint)
        self._clients[endpoint.fileno()] = client
        self._readable.append(endpoint.fileno())
        self._has_joined(client)

    def _has_joined(self, client: _Client) -> None:
        """Take notice of a client that has come."""

    def _has_left(self, client: _Client) -> None:
        """Take notice of a client that has gone."""

    def _let_go(self, fd: int) -> None:
        client = self._clients.pop(fd)
        self._has_left(client)
        self._readable.remove(fd)
        self._lost_by_gone += client.stats.frames_lost
        client.endpoint.close()

    def close(self) -> None:
        """Hang up on all clients and remove the socket file."""
        for fd in list(self._clients):
            self._let_go(fd)
        if self._listener.fileno() < 0:
            return
        self._listener.close()
        self._readable = [-1]  # the number may soon be somebody else's
        path = Path(self.path)
        with suppress(OSError):
            if path.stat().st_ino == self._inode:  # not somebody else's by now
                path.unlink()


def _listen(path: Path) -> socket.socket:
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        os.fchmod(listener.fileno(), _MODE)  # the file is born with it, whatever the umask adds
        with _directory_locked(path.parent):
            _remove_stale(path)
            listener.bind(str(path))
            path.chmod(_MODE)
            listener.listen(_BACKLOG)
        listener.setblocking(False)
    except OSError as error:
        listener.close()
        raise SimError(_explain(path, error)) from error
    except SimError:
        listener.close()
        raise
    return listener


def _explain(path: Path, error: OSError) -> str:
    if not path.parent.is_dir():
        return f"no directory {path.parent} for the bus unix:{path}; create it first"
    return f"cannot listen at unix:{path}: {error.strerror or error}"


@contextmanager
def _directory_locked(directory: Path) -> Iterator[None]:
    """Keep two emulators that start at once from removing each other's socket."""
    fd = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX)
        yield
    finally:
        os.close(fd)


def _remove_stale(path: Path) -> None:
    """Remove the socket file of an emulator that is no more.

    Raises:
        SimError: If it lives, or the file is no socket.
    """
    if not os.path.lexists(path):
        return
    if not path.is_socket():
        raise SimError(f"cannot listen at unix:{path}: a file that is no socket is in the way")
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as probe:
        probe.setblocking(False)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
        except BlockingIOError:
            pass  # alive, its queue of newcomers full
    raise SimError(f"another emulator already listens on {path}")
