"""The same frames as a master's, prepared, through the bare descriptor and nothing else."""

import os
import socket
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

from drivers.bus import Bus
from drivers.buses.slcan_codec import encode_frame
from drivers.frame import FD_FRAME_SIZE

RECEIVE_BYTES = FD_FRAME_SIZE + 1
HEAD = 4
"""Characters of a line that name an 11-bit identifier."""


class Script(NamedTuple):
    """One exchange: frames to send, how many to wait for, frames to send at the end."""

    first: Sequence[bytes]
    answers: Sequence[bytes]
    last: Sequence[bytes]


class Echo(ABC):
    """Runs a script on the descriptor that a bus uses in its own turns."""

    @abstractmethod
    def exchange(self) -> None:
        """Run the exchange once."""

    @contextmanager
    def active(self) -> Iterator[None]:
        """Have it all to itself for as long as the block lasts."""
        yield

    @abstractmethod
    def close(self) -> None: ...


class SocketEcho(Echo):
    """Unix bus and SocketCAN; waits in the kernel (blocking), which the bus does not want."""

    def __init__(self, bus: Bus, script: Script) -> None:
        self._socket = socket.socket(fileno=os.dup(bus.fileno()))
        self._script = script
        self._awaited = {frame[:4] for frame in script.answers}

    def exchange(self) -> None:
        send, recv, awaited = self._socket.send, self._socket.recv, self._awaited
        first, answers, last = self._script
        for frame in first:
            send(frame)
        missing = len(answers)
        while missing:
            missing -= recv(RECEIVE_BYTES)[:4] in awaited
        for frame in last:
            send(frame)

    @contextmanager
    def active(self) -> Iterator[None]:
        self._socket.setblocking(True)
        try:
            yield
        finally:
            self._socket.setblocking(False)

    def close(self) -> None:
        self._socket.close()


class LineEcho(Echo):
    """slcan: the same lines."""

    def __init__(self, device: str, script: Script) -> None:
        self._fd = os.open(device, os.O_RDWR | os.O_NOCTTY)
        self._first, answers, self._last = ([encode_frame(f) for f in part] for part in script)
        self._awaited = {line[:HEAD] for line in answers}
        self._answers = len(answers)

    def exchange(self) -> None:
        fd, awaited = self._fd, self._awaited
        for line in self._first:
            os.write(fd, line)
        missing, rest = self._answers, b""
        while missing:
            *lines, rest = (rest + os.read(fd, 4096)).split(b"\r")
            for line in lines:
                missing -= line[:HEAD] in awaited
        for line in self._last:
            os.write(fd, line)

    def close(self) -> None:
        os.close(self._fd)
