"""The Unix-socket bus: a client of the emulator's hub.

`AF_UNIX` `SOCK_SEQPACKET`, one 16-byte `struct can_frame` per record, in the host's byte order.
Records keep their borders and their order, and a closed peer is noticed at once.
"""

import select
import socket
from contextlib import suppress
from time import monotonic
from typing import NoReturn

from drivers.bus import Bus
from drivers.errors import BusError
from drivers.frame import ERR_BIT, FLAGS_INDEX, FRAME_SIZE

RECORD_LIMIT = FRAME_SIZE + 1
"""Bytes to ask for in one read: one more than a frame, so that a longer record shows."""

_QUEUE_BYTES = 4 << 20  # the kernel charges about 770 bytes for a record of 16
_SO_SNDBUFFORCE = 32  # asm-generic/socket.h; not in Python's socket module


def enlarge_send_queue(endpoint: socket.socket) -> None:
    """Let several thousand frames wait in the peer's queue, or as many as the host allows.

    On `AF_UNIX` the sender's `SO_SNDBUF` bounds what its peer has not read yet. Beyond
    `net.core.wmem_max` (often 208 KiB, some 550 frames) it takes CAP_NET_ADMIN.
    """
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_SNDBUFFORCE, _QUEUE_BYTES)
    except OSError:
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _QUEUE_BYTES)


def is_hung_up(endpoint: socket.socket) -> bool:
    """Tell whether the peer has closed: an empty read alone may also be an empty record."""
    poll = select.poll()
    poll.register(endpoint, select.POLLIN)
    return any(events & (select.POLLHUP | select.POLLERR) for _, events in poll.poll(0))


class UnixBus(Bus):
    """Client of the hub that listens at `path`.

    Raises:
        BusError: If nobody listens there, or access is denied.
    """

    def __init__(self, path: str) -> None:
        super().__init__()
        self.path = path
        self._socket = _connect(path)
        self._readable = (self._socket.fileno(),)
        self._send = self._socket.send
        self._receive = self._socket.recv

    def send(self, frame: bytes) -> bool:
        """Queue one frame at the hub; see `Bus.send`."""
        try:
            self._send(frame)
        except BlockingIOError:
            self.stats.send_failures += 1
            return False
        except OSError as error:
            self._raise_gone(error)
        self.stats.frames_sent += 1
        return True

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame, waiting at most `timeout_s`; see `Bus.recv`.

        Polling is one system call. With a time-out it waits first: answers come one by one, and
        a read that finds nothing costs more than the wait that finds something.
        """
        if timeout_s <= 0.0:
            return self._poll()
        deadline_s = monotonic() + timeout_s
        try:
            while select.select(self._readable, (), (), timeout_s)[0]:
                frame = self._poll()
                if frame is not None:
                    return frame
                timeout_s = max(0.0, deadline_s - monotonic())
        except (OSError, ValueError) as error:  # closed under us
            self._raise_gone(error)
        return None

    def _poll(self) -> bytes | None:
        try:
            record = self._receive(RECORD_LIMIT)
            while len(record) != FRAME_SIZE:
                self._drop(record)
                record = self._receive(RECORD_LIMIT)
        except BlockingIOError:
            return None
        except OSError as error:
            self._raise_gone(error)
        self.stats.frames_received += 1
        if record[FLAGS_INDEX] & ERR_BIT:
            self._count_error_report()
        return record

    def _drop(self, record: bytes) -> None:
        if not record and is_hung_up(self._socket):
            self._raise_gone(None)
        self.stats.malformed_records += 1

    def _raise_gone(self, error: Exception | None) -> NoReturn:
        is_ours = self._socket.fileno() < 0
        cause = "this end is closed" if is_ours else "the emulator has closed it"
        raise BusError(f"the bus at unix:{self.path} is gone: {cause}") from error

    def fileno(self) -> int:
        """Descriptor of the socket, -1 once closed."""
        return self._socket.fileno()

    def close(self) -> None:
        """Leave the hub. Frames already sent still reach it."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits in `recv`
        self._socket.close()
        self._readable = (-1,)  # the number may soon be somebody else's


def _connect(path: str) -> socket.socket:
    endpoint = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        endpoint.setblocking(False)
        enlarge_send_queue(endpoint)
        endpoint.connect(path)
    except OSError as error:
        endpoint.close()
        reason = error.strerror or str(error)
        raise BusError(f"no bus at unix:{path}: {reason}; start `hil emulate` first") from error
    return endpoint
