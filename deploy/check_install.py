#!/usr/bin/env python3
"""Follow docs/install.md on a fresh Debian: every `sh` block of the page, up to a running service.

The Debian is built in a scratch directory and booted by systemd-nspawn (root and a Debian host are
needed; the packages mmdebstrap and systemd-container are installed if missing). What happens there
is judged step by step and printed as a table; nothing is left behind.

Exit status: 0 if no step failed, 1 if one did, 125 if the check cannot be made on this host.
"""

import argparse
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import NamedTuple, NoReturn

from check_install_root import (
    FreshRoot,
    InstallError,
    MissingError,
    received_bytes,
    require_packages,
)
from check_install_steps import Installation, NotHereError, Steps, steps

NO_CHECK = 125


class Result(NamedTuple):
    """How one step ended: `pass`, `FAIL` or `not here`."""

    step: str
    verdict: str
    time_s: float
    note: str


def run_steps(planned: Steps, say: Callable[[str], None]) -> list[Result]:
    """Run the steps in order; one that fails ends the check if the rest needs it."""
    results = []
    for name, (step, is_needed) in planned.items():
        began_s = time.monotonic()
        try:
            verdict, note = "pass", step()
        except InstallError as error:
            verdict, note = "FAIL", str(error)
        except NotHereError as error:
            verdict, note = "not here", str(error)
        results.append(Result(name, verdict, time.monotonic() - began_s, note))
        say(row(results[-1]))
        if verdict == "FAIL" and is_needed:
            break
    return results


def row(result: Result) -> str:
    """Return a step's line of the table."""
    return f"{result.verdict:8}  {result.step:18} {result.time_s:6.1f} s  {result.note}"


def main() -> int:
    """Build, follow, judge, remove."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    scratch = Path("/var/tmp")  # noqa: S108 - a directory of random name is made in it
    parser.add_argument("--scratch", type=Path, default=scratch, metavar="DIR",
                        help="where the root is built: 2 GB, no tmpfs with nodev")  # fmt: skip
    parser.add_argument("--keep", action="store_true", help="leave the root there, not booted")
    parser.add_argument("--skip", action="append", default=[], metavar="STEP", help="leave it out")
    options = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _exit_on_signal)
    try:
        require_packages()
        return check(options.scratch, options.skip, is_kept=options.keep)
    except MissingError as error:
        _say(f"check_install: cannot run: {error}")
        return NO_CHECK


def check(scratch: Path, skipped: list[str], *, is_kept: bool = False) -> int:
    """Run all steps in a new root; return the exit status."""
    began_s, began_bytes = time.monotonic(), received_bytes()
    folder = Path(tempfile.mkdtemp(prefix="hil-install-", dir=scratch))
    folder.chmod(0o755)  # the services of the root are others than root
    with closing(FreshRoot(folder, is_kept=is_kept)) as root:
        planned = steps(Installation(root))
        results = run_steps({k: v for k, v in planned.items() if k not in skipped}, _say)
    counts = [
        sum(r.verdict == verdict for r in results) for verdict in ("pass", "FAIL", "not here")
    ]
    reached = len(results) + len(skipped)
    received_MB = (received_bytes() - began_bytes) / 1e6
    _say(
        f"{counts[0]} pass, {counts[1]} failed, {counts[2]} not here, {len(planned) - reached} not "
        f"reached, {len(skipped)} skipped; {time.monotonic() - began_s:.0f} s, the host received "
        f"{received_MB:.0f} MB"
    )
    return 1 if counts[1] else 0


def _say(line: str) -> None:
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


def _exit_on_signal(number: int, _: object) -> NoReturn:
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
