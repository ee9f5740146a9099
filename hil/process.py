"""Entry of the daemon's child processes: `python -m hil.process NAME FD PARENT [ARGUMENT]`."""

import sys
from importlib import import_module


def main(arguments: list[str]) -> int:
    """Run the child called by name (`loop`, `gateway`, `recorder`) and return its exit status."""
    name, shared_fd, parent_pid, *rest = arguments
    entry = import_module(f"hil.{name}").main
    status: int = entry(int(shared_fd), int(parent_pid), *rest)
    return status


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
