"""What a bus on a serial line shares with any other: bytes out, bytes in, waiting, hanging up."""

import errno
import os
import select
from abc import abstractmethod
from collections import deque
from contextlib import suppress
from time import monotonic
from typing import NoReturn

from drivers.bus import Bus
from drivers.errors import BusError

_READ_BYTES = 4096
_FULL = frozenset({errno.EAGAIN, errno.ENOBUFS})


class SerialBus(Bus):
    """A bus whose frames are text or packets on a tty.

    Args:
        fd: The tty, raw and non-blocking; closed with the bus.
        name: Its bus address, for messages.
    """

    def __init__(self, fd: int, name: str) -> None:
        super().__init__()
        self._fd = fd
        self._name = name
        self._frames: deque[bytes] = deque()
        self._pending = b""
        """Rest of what the port took only in part."""
        poll = select.poll()
        poll.register(fd, select.POLLIN)
        self._poll = poll.poll

    @abstractmethod
    def _sort(self, chunk: bytes) -> None:
        """Make frames of what has been read, and append them to `_frames`."""

    def fileno(self) -> int:
        """Always -1: one read may bring several frames, which wait here and not at the port."""
        return -1

    def close(self) -> None:
        """Leave the port. What it has taken still goes out."""
        if self._fd < 0:
            return
        with suppress(OSError):
            os.write(self._fd, self._pending)
        os.close(self._fd)
        self._fd = -1
        self._pending = b""
        self._frames.clear()
        self._poll = lambda _timeout_ms=None: [(-1, select.POLLNVAL)]

    def _put(self, packet: bytes) -> bool:
        """Write one frame, or nothing of it; a part that is left follows with the next call."""
        if self._pending:
            self._flush()
            if self._pending:
                return False
        written = self._write(packet)
        if not written:
            return False
        if written != len(packet):
            self._pending = packet[written:]
        return True

    def _flush(self) -> None:
        self._pending = self._pending[self._write(self._pending) :]

    def _write(self, data: bytes) -> int:
        try:
            return os.write(self._fd, data)
        except OSError as error:
            if error.errno not in _FULL:
                self._raise_gone(error)
            return 0

    def _await(self, timeout_s: float) -> bool:
        """Wait for frames; False if there is none when the time is up."""
        deadline_s = monotonic() + timeout_s
        while self._exchange(timeout_s):
            if self._frames:
                return True
            timeout_s = max(0.0, deadline_s - monotonic())
        return False

    def _exchange(self, timeout_s: float) -> bool:
        """Write what is pending and read what has come; False if neither can be in time."""
        port = (self._fd,)
        try:
            ready = select.select(port, port if self._pending else (), (), timeout_s)
        except (OSError, ValueError) as error:  # closed under us
            self._raise_gone(error)
        if ready[1]:
            self._flush()
        if ready[0]:
            self._read()
        return any(ready)

    def _read(self) -> None:
        """Take what the port has."""
        try:
            chunk = os.read(self._fd, _READ_BYTES)
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return
            self._raise_gone(error)
        if not chunk:  # a port that has been hung up on
            self._raise_gone(None)
        self._sort(chunk)

    def _raise_gone(self, error: Exception | None) -> NoReturn:
        if self._fd < 0:
            raise BusError(f"the bus {self._name} is closed") from error
        detail = f" ({error.strerror})" if isinstance(error, OSError) else ""
        raise BusError(
            f"the bus {self._name} is gone: adapter unplugged, or its emulator ended{detail}; "
            "plug it in and start again"
        ) from error
