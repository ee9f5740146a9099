"""The Unix-socket bus: a client of the emulator's hub.

`AF_UNIX` `SOCK_SEQPACKET`, one `struct can_frame` (16 bytes) or `struct canfd_frame` (72) per
record, in the host's byte order.
Records keep their borders and their order, and a closed peer is noticed at once.
"""

import select
import socket
from contextlib import suppress
from typing import NoReturn

from drivers.buses.kernel_socket import SocketBus
from drivers.errors import BusError
from drivers.frame import ERR_BIT, FD_FRAME_SIZE, FLAGS_INDEX, RECORD_SIZES

RECORD_LIMIT = FD_FRAME_SIZE + 1
"""Bytes to ask for in one read: one more than the longest frame, so that a longer record shows."""

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


class UnixBus(SocketBus):
    """Client of the hub that listens at `path`.

    Raises:
        BusError: If nobody listens there, or access is denied.
    """

    def __init__(self, path: str) -> None:
        super().__init__(_connect(path))
        self.path = path

    def _take(self) -> bytes | None:
        try:
            record = self._receive(RECORD_LIMIT)
            while len(record) not in RECORD_SIZES:
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

    def close(self) -> None:
        """Leave the hub. Frames already sent still reach it."""
        with suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits in `recv`
        super().close()


def _connect(path: str) -> socket.socket:
    endpoint = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    try:
        endpoint.setblocking(False)
        enlarge_send_queue(endpoint)
        endpoint.connect(path)
    except OSError as error:
        endpoint.close()
        reason = error.strerror or str(error)
        raise BusError(f"no bus at unix:{path}: {reason}; {_remedy(error)}") from error
    return endpoint


def _remedy(error: OSError) -> str:
    if isinstance(error, PermissionError):
        return "the bus is for the emulator's user and group"
    if isinstance(error, BlockingIOError):
        return "the emulator takes no newcomers: is it stopped?"
    return "start `hil emulate` first"
