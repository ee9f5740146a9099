"""Checks of host, configuration, bus and Zenoh, each with a verdict and a remedy."""

import errno
import os
import platform
import resource
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from drivers.bus import open_bus, split_address
from drivers.errors import DriverError
from hil.budget import REMEDY, WARNING_SHARE, bus_budget
from hil.config import Config

Level = Literal["pass", "warn", "fail"]


@dataclass(frozen=True, slots=True)
class Finding:
    """One check: what was found and, unless it passed, what to do about it."""

    name: str
    level: Level
    found: str
    remedy: str = ""


def examine(config: Config) -> list[Finding]:
    """Run every check. Nothing is sent to an amplifier."""
    checks: tuple[Callable[[Config], Finding], ...] = (
        _python,
        _kernel,
        _scheduler,
        _memlock,
        _cores,
        _governor,
        _clock,
        _bus,
        check_bus_load,
        _zenoh,
    )
    return [check(config) for check in checks]


def _python(config: Config) -> Finding:
    del config
    return Finding(
        "python", "pass", f"{platform.python_implementation()} {platform.python_version()}"
    )


def _kernel(config: Config) -> Finding:
    del config
    version = platform.version()
    if "PREEMPT_RT" in version:
        return Finding("kernel", "pass", f"{platform.release()}, PREEMPT_RT")
    model = "PREEMPT_DYNAMIC" if "PREEMPT_DYNAMIC" in version else "no full preemption"
    return Finding(
        "kernel", "warn", f"{platform.release()}, {model}", "use a PREEMPT_RT kernel for hardware"
    )


def _scheduler(config: Config) -> Finding:
    wanted = config.loop.priority
    before, param = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(wanted))
        os.sched_setscheduler(0, before, param)
    except OSError as error:
        return Finding(
            "scheduler",
            _severity(config),
            f"SCHED_FIFO priority {wanted} not granted ({error.strerror})",
            f"add '@realtime - rtprio {wanted}' to /etc/security/limits.d, or use "
            'loop.realtime = "best_effort"',
        )
    return Finding("scheduler", "pass", f"SCHED_FIFO priority {wanted} granted")


def _memlock(config: Config) -> Finding:
    soft, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if soft == resource.RLIM_INFINITY or os.geteuid() == 0:
        return Finding("memlock", "pass", "unlimited")
    return Finding(
        "memlock",
        _severity(config),
        f"limit {soft // 1024} KiB",
        "add '@realtime - memlock unlimited' to /etc/security/limits.d",
    )


def _severity(config: Config) -> Level:
    return "fail" if config.loop.realtime == "required" else "warn"


def _cores(config: Config) -> Finding:
    usable = os.sched_getaffinity(0)
    cpu = config.loop.cpu
    if cpu is not None and cpu not in usable:
        return Finding("cores", "fail", f"core {cpu} is not among {sorted(usable)}", "set loop.cpu")
    if len(usable) < 2:
        return Finding("cores", "warn", "1 core", "give the loop a core of its own")
    isolated = _read("/sys/devices/system/cpu/isolated")
    return Finding("cores", "pass", f"{len(usable)} usable, isolated: {isolated or 'none'}")


def _governor(config: Config) -> Finding:
    del config
    governor = _read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor")
    if governor in ("", "performance"):
        return Finding("governor", "pass", governor or "no frequency scaling visible")
    return Finding("governor", "warn", governor, "cpupower frequency-set -g performance")


def _clock(config: Config) -> Finding:
    del config
    source = _read("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    if source in ("tsc", "kvm-clock", "arch_sys_counter", ""):
        return Finding("clock source", "pass", source or "unknown")
    return Finding("clock source", "warn", source, "a slow clock costs microseconds per reading")


def _bus(config: Config) -> Finding:
    address = config.bus.address
    scheme, rest = split_address(address)
    try:
        with open_bus(address):
            pass
    except DriverError as error:
        return Finding("bus", "fail", str(error), "see the message")
    if scheme != "socketcan":
        return Finding("bus", "pass", f"{address} can be joined")
    queue = _read(f"/sys/class/net/{rest}/tx_queue_len")
    if queue.isdigit() and int(queue) < 4 * config.joints:
        remedy = f"ip link set {rest} txqueuelen 128"
        return Finding("bus", "warn", f"{address}, send queue of {queue} frames", remedy)
    return Finding("bus", "pass", f"{address} can be joined, send queue of {queue} frames")


def check_bus_load(config: Config) -> Finding:
    """Judge the bus budget alone (`hil.budget`)."""
    budget = bus_budget(config)
    found = f"a cycle needs {100 * budget.share:.1f} % of the period at worst"
    if not budget.is_fitting:
        return Finding("bus load", "fail", f"{found}: {budget.arithmetic()}", REMEDY)
    if budget.share > WARNING_SHARE:
        return Finding("bus load", "warn", found, REMEDY)
    return Finding("bus load", "pass", found)


def _zenoh(config: Config) -> Finding:
    for endpoint in config.zenoh.listen:
        protocol, _, address = endpoint.partition("/")
        host, _, port = address.rpartition(":")
        if protocol != "tcp" or not port.isdigit():
            continue
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host.strip("[]"), int(port)))
            except OSError as error:
                level: Level = "warn" if error.errno == errno.EADDRINUSE else "fail"
                return Finding("zenoh", level, f"{endpoint}: {error.strerror}", "set zenoh.listen")
        if host not in ("127.0.0.1", "localhost", "[::1]"):
            return Finding(
                "zenoh", "warn", f"listens on {endpoint}", "anyone who reaches it can command"
            )
    return Finding("zenoh", "pass", ", ".join(config.zenoh.listen) or "listens nowhere")


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="ascii").strip()
    except OSError:
        return ""
