#!/usr/bin/env python3
"""Run a command on a Linux kernel that has CAN interfaces: vcan0, vcan1 and the pair vxcan0/1.

Where the host's kernel has them, the command gets a network namespace of its own. Elsewhere it
runs on Debian's user-mode-linux, a kernel that is an ordinary process: it sees the host's files
(changes go to an overlay that is thrown away, except below --rw), and its output and exit status
come through. See docs/lab.md.

Exit status: the command's; 124 if it took too long; 125 if there is no such kernel.
"""

import argparse
import os
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import BinaryIO, NoReturn

HERE = Path(__file__).resolve().parent
KERNEL = Path("/usr/bin/linux.uml")
MODULES = Path("/usr/lib/uml/modules")
PACKAGES = {  # tool -> the Debian package that brings it
    "linux.uml": "user-mode-linux",
    "insmod": "kmod",
    "mount": "mount",
    "taskset": "util-linux",
    "ip": "iproute2",
    "candump": "can-utils",
}
TOOL_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"
TIMED_OUT = 124
NO_LAB = 125
POLL_S = 0.02

Outputs = list[tuple[BinaryIO, BinaryIO]]
"""Files to follow, each with the stream its growth is copied to."""


class LabError(Exception):
    """There is no kernel with CAN to run on; one line says what is missing."""


# --- the host's own kernel ---------------------------------------------------------------------


def enter_namespace() -> list[str]:
    """Return the command that enters a network namespace with the lab's interfaces.

    The interfaces go with the last process in there. /sys shows the interfaces of the namespace
    in which it was mounted, so it is mounted anew.

    Raises:
        LabError: If the host's kernel has no vcan, or lets nobody but others make one.
    """
    enter = ["unshare", "--mount", "--net"]
    if os.geteuid():
        enter.append("--map-root-user")
    interfaces = shlex.quote(str(HERE / "interfaces.sh"))
    enter += ["sh", "-c", f'mount -t sysfs sys /sys && . {interfaces} && "$@"', "sh"]
    try:
        done = subprocess.run(  # noqa: S603 - our own arguments
            [*enter, "ip", "-brief", "link"],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise LabError(f"no network namespace: {error}") from error
    if done.returncode or not _has_tools("candump"):
        cause = (done.stderr.strip().splitlines() or ["package can-utils is missing"])[-1]
        raise LabError(f"the host's kernel has no CAN for us: {cause}")
    return enter


def run_in_namespace(enter: list[str], command: list[str], timeout_s: float) -> int:
    """Run the command on the host's kernel and return its exit status."""
    process = subprocess.Popen([*enter, *command], start_new_session=True)  # noqa: S603
    try:
        return process.wait(timeout_s)
    except subprocess.TimeoutExpired:
        return TIMED_OUT
    finally:
        _end_group(process)


# --- the user-mode kernel ----------------------------------------------------------------------


def require_packages() -> None:
    """Install what is missing, as root with apt-get.

    Raises:
        LabError: If something is missing and cannot be installed.
    """
    if sys.platform != "linux":
        raise LabError(f"it needs Linux, this is {sys.platform}")
    missing = sorted({package for tool, package in PACKAGES.items() if not _has_tools(tool)})
    if not missing:
        return
    install = ["apt-get", "install", "-y", "--no-install-recommends", *missing]
    if not _has_tools("apt-get"):
        raise LabError(f"Debian packages are missing and there is no apt-get: {' '.join(missing)}")
    if os.geteuid():
        raise LabError(f"packages are missing; `sudo {shlex.join(install)}`")
    _say(f"installing {' '.join(missing)}")
    for step in (["apt-get", "update"], install):
        done = subprocess.run(  # noqa: S603 - our own arguments
            step,
            env=os.environ | {"DEBIAN_FRONTEND": "noninteractive"},
            capture_output=True,
            text=True,
            check=False,
        )
        if done.returncode:
            cause = (done.stderr.strip() or done.stdout.strip() or "no reason given").splitlines()
            raise LabError(f"`{shlex.join(step)}` failed: {cause[-1]}")


def run_in_guest(command: list[str], writable: list[Path], timeout_s: float, mem_MB: int) -> int:
    """Boot the user-mode kernel, run the command in it, and return its exit status.

    Raises:
        LabError: If the guest does not come up, or dies.
    """
    with tempfile.TemporaryDirectory(prefix="hil-lab-") as folder, ExitStack() as stack:
        exchange = Path(folder)
        _write_orders(exchange, command, writable)
        outputs: Outputs = []
        for name, sink in (("stdout", sys.stdout.buffer), ("stderr", sys.stderr.buffer)):
            (exchange / name).touch()
            outputs.append((stack.enter_context((exchange / name).open("rb")), sink))
        log = exchange / "log"
        kernel = _boot(exchange, log, mem_MB)
        try:
            status = _await_status(kernel, exchange / "status", outputs, timeout_s)
        finally:
            _end_group(kernel)
        if status is None:
            last_words = log.read_text("utf-8", "replace").split("\n")[-4:]
            raise LabError(f"the user-mode kernel died: {' '.join(last_words).strip()}")
        return status


def _write_orders(exchange: Path, command: list[str], writable: list[Path]) -> None:
    """Leave for guest.sh what it shall run: the same directory and environment as here."""
    kept = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment = [f"{key}={value}" for key, value in kept.items()]  # bytecode goes to the overlay
    line = shlex.join(["env", "-i", *environment, *command])
    script = f"cd {shlex.quote(str(Path.cwd()))} && exec {line}\n"
    (exchange / "command").write_text(script, "utf-8")
    (exchange / "writable").write_text("".join(f"{path.resolve()}\n" for path in writable), "utf-8")


def _boot(exchange: Path, log: Path, mem_MB: int) -> "subprocess.Popen[bytes]":
    modules = sorted(path.parent for path in MODULES.glob("*/kernel"))
    if not modules:
        raise LabError(f"no kernel modules in {MODULES}; reinstall the package user-mode-linux")
    line = ["taskset", "--cpu-list", str(_idlest_cpu())]  # it hands over to itself all the time
    line += [str(KERNEL), f"mem={mem_MB}M", f"umid={exchange.name}", f"uml_dir={exchange}/"]
    line += ["rootfstype=hostfs", "rootflags=/", "ro", "random.trust_cpu=on", "ssl=null"]
    line += ["con=null", "con0=null,fd:1", f"LAB={exchange}", f"MODULES={modules[-1]}"]
    line += ["init=/bin/sh", "--", str(HERE / "guest.sh")]
    with log.open("wb") as output:
        return subprocess.Popen(  # noqa: S603 - our own arguments
            line,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            env=os.environ | {"TMPDIR": _memory_directory(mem_MB)},
            start_new_session=True,
        )


def _idlest_cpu() -> int:
    """Return the processor that had least to do in the last 50 ms."""

    def idle() -> dict[int, int]:
        rows = [line.split() for line in Path("/proc/stat").read_text("ascii").splitlines()]
        return {int(r[0][3:]): int(r[4]) for r in rows if r[0][:3] == "cpu" and r[0][3:].isdigit()}

    before = idle()
    time.sleep(0.05)
    after = idle()
    return max(os.sched_getaffinity(0), key=lambda cpu: after.get(cpu, 0) - before.get(cpu, 0))


def _memory_directory(mem_MB: int) -> str:
    """Return where the guest's memory may lie: a file that is mapped executable."""
    for folder in ("/dev/shm", tempfile.gettempdir()):  # noqa: S108 - RAM, if there is enough
        with suppress(OSError):
            file_system = os.statvfs(folder)
            is_roomy = file_system.f_bavail * file_system.f_frsize > mem_MB << 20
            if is_roomy and not file_system.f_flag & os.ST_NOEXEC:
                return folder
    raise LabError(
        f"no room for {mem_MB} MB of guest memory in /dev/shm or the temporary directory"
    )


def _await_status(
    kernel: "subprocess.Popen[bytes]", status: Path, outputs: Outputs, timeout_s: float
) -> int | None:
    """Copy the command's output until its exit status is there; None if the kernel dies."""
    deadline_s = time.monotonic() + timeout_s
    while True:
        is_over = status.exists()
        is_dead = kernel.poll() is not None
        is_late = time.monotonic() > deadline_s
        for source, sink in outputs:
            with suppress(BrokenPipeError):
                sink.write(source.read())
                sink.flush()
        if is_over:
            return int(status.read_text("ascii"))
        if is_late:
            return TIMED_OUT
        if is_dead:
            return None
        time.sleep(POLL_S)


# --- both --------------------------------------------------------------------------------------


def _has_tools(tool: str) -> bool:
    return any((Path(folder) / tool).exists() for folder in TOOL_PATH.split(":"))


def _end_group(process: "subprocess.Popen[bytes]") -> None:
    """End a process and all that it started."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _say(line: str) -> None:
    sys.stderr.write(f"lab: {line}\n")
    sys.stderr.flush()


def run(options: argparse.Namespace) -> int:
    """Run the command on the first kernel that can be had, and say which and how long."""
    began_s = time.monotonic()
    enter = None
    if options.kernel != "uml":
        try:
            enter = enter_namespace()
        except LabError:
            if options.kernel == "host":
                raise
    if enter is not None:
        _say(f"on the host's kernel {os.uname().release}, in a network namespace")
        status = run_in_namespace(enter, options.command, options.timeout)
    else:
        require_packages()
        _say("on a user-mode kernel")
        status = run_in_guest(options.command, options.rw, options.timeout, options.mem)
    verdict = f"timed out after {options.timeout:g} s" if status == TIMED_OUT else f"exit {status}"
    _say(f"{verdict}, {time.monotonic() - began_s:.1f} s")
    return status


def main() -> int:
    """Read the command line and run; a lab that is not to be had ends with one line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else "")
    parser.add_argument("--kernel", choices=("auto", "host", "uml"), default="auto")
    parser.add_argument("--rw", type=Path, action="append", default=[], metavar="DIR",
                        help="directory of the host to write to (user-mode kernel)")  # fmt: skip
    parser.add_argument("--timeout", type=float, default=900.0, metavar="S")
    parser.add_argument("--mem", type=int, default=1024, metavar="MB", help="of the guest")
    parser.add_argument("--optional", action="store_true",
                        help="without a lab only warn, unless CI=true")  # fmt: skip
    parser.add_argument("command", nargs="+")
    options = parser.parse_args()
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, _exit_on_signal)
    try:
        return run(options)
    except LabError as error:
        is_forgiven = options.optional and os.environ.get("CI") != "true"
        _say(f"{'WARNING: not run' if is_forgiven else 'cannot run'}: {error}")
        return 0 if is_forgiven else NO_LAB


def _exit_on_signal(number: int, _: object) -> NoReturn:
    sys.exit(128 + number)


if __name__ == "__main__":
    sys.exit(main())
