"""Load on the host, of one kind per process: what the latency of a real-time loop must survive.

`python -m hil.stress KIND PARENT` runs until it is ended, or until its parent has gone.
"""

import os
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Final

from hil.realtime import die_with_parent

_BLOCK: Final = 1 << 20
_MEMORY_BLOCKS: Final = 64
_FILE_BLOCKS: Final = 32
_DATAGRAM: Final = bytes(1400)
_BURST: Final = 64


def _load_cpu() -> None:
    """Calculate, and nothing else."""
    value = 1
    while True:
        value = value * 1_103_515_245 % 2_147_483_647


def _load_memory() -> None:
    """Copy 64 MiB over and over: more than caches hold."""
    source = memoryview(bytearray(_MEMORY_BLOCKS * _BLOCK))
    target = bytearray(len(source))
    while True:
        target[:] = source


def _load_io() -> None:
    """Write 32 MiB to disk and start again at the file's beginning."""
    block = os.urandom(_BLOCK)
    with tempfile.TemporaryFile() as file:
        while True:
            file.seek(0)
            for _ in range(_FILE_BLOCKS):
                file.write(block)
                file.flush()
                os.fsync(file.fileno())


def _load_network() -> None:
    """Send datagrams to oneself over the loopback interface."""
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender,
    ):
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        sender.connect(receiver.getsockname())
        while True:
            for _ in range(_BURST):
                sender.send(_DATAGRAM)
            _drain(receiver)


def _drain(receiver: socket.socket) -> None:
    try:
        while True:
            receiver.recv(2048)
    except BlockingIOError:
        pass


KINDS: Final[dict[str, Callable[[], None]]] = {
    "cpu": _load_cpu,
    "memory": _load_memory,
    "io": _load_io,
    "network": _load_network,
}
"""Kind of load -> what makes it; `cpu` is made once per usable core."""


@contextmanager
def loaded(kinds: Iterable[str]) -> Iterator[list[int]]:
    """Load the host while the context lasts; gives the process ids of the stressors."""
    cores = len(os.sched_getaffinity(0))
    wanted = [kind for kind in kinds for _ in range(cores if kind == "cpu" else 1)]
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for kind in wanted:
            command = [sys.executable, "-m", "hil.stress", kind, str(os.getpid())]
            processes.append(subprocess.Popen(command))  # noqa: S603 - ourselves
        yield [process.pid for process in processes]
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


if __name__ == "__main__":
    die_with_parent(int(sys.argv[2]))
    KINDS[sys.argv[1]]()
