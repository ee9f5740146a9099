"""`python -m benchmarks [NAME ...] [--quick] [--check]`: prints figures and targets."""

import argparse
import os
import platform
import sys
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from benchmarks.measure import Target
from hil.host_checks import is_optimised_build

NAMES = ("cycle", "exchange", "buses", "scale", "sim", "law", "arm", "codec", "recording", "remote")
LIBRARIES = ("python-can", "canopen", "pymunk", "numpy", "protobuf", "mcap")


def main(arguments: list[str]) -> int:
    """Run the benchmarks asked for, all by default.

    Returns:
        0; with `--check`, 1 if a target was missed.
    """
    parser = argparse.ArgumentParser(prog="python -m benchmarks")
    parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(NAMES))
    parser.add_argument("--quick", action="store_true", help="a tenth of the repetitions")
    parser.add_argument("--check", action="store_true", help="exit 1 if a target is missed")
    options = parser.parse_args(arguments)
    unknown = [name for name in options.names if name not in NAMES]
    if unknown:
        parser.error(f"no benchmark {unknown[0]!r}; there are: {', '.join(NAMES)}")
    print_header()
    targets: list[Target] = []
    for name in options.names or NAMES:
        scale = 0.1 if options.quick else 1.0
        targets += import_module(f"benchmarks.{name}").run(scale)
    print("\n== targets")
    for target in targets:
        print(f"  {target.text()}")
    return 1 if options.check and not all(target.is_met for target in targets) else 0


def print_header() -> None:
    """Name everything the figures depend on."""
    cores, load = os.cpu_count(), os.getloadavg()[0]
    print(f"machine    {_processor()}, {cores} cores, load {load:.2f} at the start")
    print(f"kernel     {platform.system()} {platform.release()} {platform.version()}")
    build = "with" if is_optimised_build() else "WITHOUT"
    print(f"python     {platform.python_implementation()} {platform.python_version()} {build} PGO")
    print(f"libraries  {', '.join(f'{name} {version(name)}' for name in LIBRARIES)}")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines():
        key, _, value = line.partition(":")
        if key.strip() == "model name":
            return value.strip()
    return platform.machine()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
