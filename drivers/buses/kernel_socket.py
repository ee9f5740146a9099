"""What the back-ends on a non-blocking kernel socket share: sending, waiting and closing."""

import errno
import select
import socket
from abc import abstractmethod
from time import monotonic
from typing import NoReturn

from drivers.bus import Bus

_FULL = frozenset({errno.EAGAIN, errno.ENOBUFS})


class SocketBus(Bus):
    """A bus whose frames are the records of one socket."""

    def __init__(self, endpoint: socket.socket) -> None:
        super().__init__()
        self._socket = endpoint
        self._send = endpoint.send
        self._receive = endpoint.recv
        self._readable = (endpoint.fileno(),)
        poll = select.poll()
        poll.register(endpoint, select.POLLIN)
        self._poll = poll.poll

    def send(self, frame: bytes) -> bool:
        """Queue one frame for transmission; see `Bus.send`."""
        try:
            self._send(frame)
        except OSError as error:
            if error.errno not in _FULL:
                self._raise_gone(error)
            self.stats.send_failures += 1
            return False
        self.stats.frames_sent += 1
        return True

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame, waiting at most `timeout_s`; see `Bus.recv`.

        Of the ways to find out that nothing has come yet, poll() is the cheapest, but its
        time-out has milliseconds; a read that fails costs three times as much.
        """
        if self._poll(0):
            frame = self._take()
            if frame is not None:
                return frame
        return self._await(timeout_s) if timeout_s > 0.0 else None

    def _await(self, timeout_s: float) -> bytes | None:
        deadline_s = monotonic() + timeout_s
        try:
            while select.select(self._readable, (), (), timeout_s)[0]:
                frame = self._take()
                if frame is not None:
                    return frame
                timeout_s = max(0.0, deadline_s - monotonic())
        except (OSError, ValueError) as error:  # closed under us
            self._raise_gone(error)
        return None

    @abstractmethod
    def _take(self) -> bytes | None:
        """Return the next frame that is there already, counted, or None."""

    @abstractmethod
    def _raise_gone(self, error: Exception | None) -> NoReturn:
        """Raise the `BusError` that says what has become of the bus."""

    def fileno(self) -> int:
        """Descriptor of the socket, -1 once closed."""
        return self._socket.fileno()

    def close(self) -> None:
        """Close the socket. Frames already sent still reach the bus."""
        self._socket.close()
        self._readable = (-1,)  # the number may soon be somebody else's
