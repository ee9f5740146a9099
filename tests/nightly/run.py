"""Runs every part of `make nightly`, whatever fails, and ends with the worst exit status.

`python -m tests.nightly.run`; `HIL_FUZZ_FRAMES` changes how many frames each fuzz test sends.
"""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

FRAMES = os.environ.get("HIL_FUZZ_FRAMES", "1000000")
FUZZ = "fuzz or random_and_mutated"
COUNTS = {
    "HIL_FUZZ_FRAMES": FRAMES,
    "HIL_TEST_MIT_FUZZ_FRAMES": FRAMES,
    "HIL_TEST_ODRIVE_FUZZ_FRAMES": FRAMES,
    "HIL_TEST_MOTEUS_FUZZ_FRAMES": FRAMES,
    "HIL_TEST_SLCAN_FUZZ_BYTES": FRAMES,
}
PARTS: dict[str, tuple[str, ...]] = {
    "soak": ("-s", "tests/nightly/test_soak.py"),
    "random frames to every family": ("-s", "tests/nightly/test_fuzz.py"),
    "determinism and faults, whole runs": (
        "--timeout=7200", "tests/hil/test_determinism.py", "tests/hil/test_fault_matrix.py",
    ),
    "recorder killed again and again": ("--timeout=1800", "tests/hil/test_recorder.py"),
    "hostile requests": ("--timeout=1800", "tests/nightly/test_hostile_requests.py"),
    "families and slcan, long fuzzing": (
        "-o", "timeout=7200", "-k", FUZZ, "tests/drivers", "tests/sim_backend",
    ),
    "installation in a clean environment": ("tests/deploy",),
}  # fmt: skip
"""What runs, in this order: name -> arguments of pytest. Nothing may run beside the soak."""
SIGNAL_STATUS = 128


class Result(NamedTuple):
    """How one part ended."""

    name: str
    status: int
    time_s: float


def run_all(commands: dict[str, Sequence[str]], say: Callable[[str], None]) -> list[Result]:
    """Run the commands one after the other, the next one also after a failure."""
    results = []
    for name, command in commands.items():
        say(f"\n=== {name}")
        start_s = time.monotonic()
        code = subprocess.run(command, env=os.environ | COUNTS, check=False).returncode
        status = code if code >= 0 else SIGNAL_STATUS - code
        results.append(Result(name, status, time.monotonic() - start_s))
    return results


def summary(results: Sequence[Result]) -> list[str]:
    """Return one line a part, those that failed by their exit status."""
    return [
        f"{'pass' if r.status == 0 else f'FAIL ({r.status})':10} {r.time_s:7.0f} s  {r.name}"
        for r in results
    ]


def main() -> int:
    """Run every part; return the worst exit status."""
    os.environ["HIL_NIGHTLY"] = "1"
    pytest = [sys.executable, "-m", "pytest"]
    results = run_all(
        {name: [*pytest, *words] for name, words in PARTS.items()},
        lambda line: print(line, flush=True),  # noqa: T201 - a program
    )
    print("\n=== nightly", *summary(results), sep="\n", flush=True)  # noqa: T201
    return max(result.status for result in results)


if __name__ == "__main__":
    sys.exit(main())
