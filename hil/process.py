"""Entry of the daemon's child processes: `python -m hil.process NAME FD PARENT [ARGUMENT]`."""

import os
import sys
from collections.abc import Callable
from importlib import import_module
from time import monotonic, sleep

from hil.shared import SharedMemory

OUTLAST_EVERY_S = 0.02
SILENCE_S = 1.0
"""A loop that has not shown itself for this long has ended."""


def outlast_loop(shared: SharedMemory, parent_pid: int, work: Callable[[], object]) -> None:
    """Without a supervisor, which ends the loop first, go on with `work` until the loop has ended.

    Args:
        shared: Where the loop shows itself.
        parent_pid: The supervisor. While it lives, this returns at once.
        work: Called again and again, for as long as a damped stop may take at most.
    """
    deadline_s = monotonic() + shared.config.controller.stop_time_s + 1.0
    while os.getppid() != parent_pid and monotonic() < deadline_s:
        if not shared.is_alive("loop", SILENCE_S):
            return
        work()
        sleep(OUTLAST_EVERY_S)


def main(arguments: list[str]) -> int:
    """Run the child called by name (`loop`, `gateway`, `recorder`) and return its exit status."""
    name, shared_fd, parent_pid, *rest = arguments
    entry = import_module(f"hil.{name}").main
    status: int = entry(int(shared_fd), int(parent_pid), *rest)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
