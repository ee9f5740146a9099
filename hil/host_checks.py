"""What of the host makes a control loop late, read from the kernel's own files.

Every check takes the configuration and, for tests, the directory that stands for `/`.
"""

import os
import platform
import resource
import sys
import sysconfig
from collections.abc import Callable
from pathlib import Path

from hil.config import Config
from hil.finding import Finding, Level

_ROOT = Path("/")
_FAST_CLOCKS = ("tsc", "kvm-clock", "arch_sys_counter", "")


def is_optimised_build() -> bool:
    """Tell whether this Python was compiled with the help of a profile (PGO).

    Distributions do so by means of their own, which the build's options do not show.
    """
    options = str(sysconfig.get_config_var("CONFIG_ARGS") or "")
    return "--enable-optimizations" in options or sys.base_prefix == "/usr"


def interpreter(config: Config) -> Finding:
    """Judge how Python was built: the loop's own work is the interpreter's."""
    del config
    name = f"{platform.python_implementation()} {platform.python_version()}"
    if is_optimised_build():
        return Finding("python", "pass", name)
    return Finding(
        "python",
        "warn",
        f"{name}, built without profile-guided optimisation",
        "use the distribution's Python, or build one with --enable-optimizations --with-lto",
    )


def kernel(config: Config, root: Path = _ROOT) -> Finding:
    """Judge the kernel's preemption model."""
    del config
    release, version = platform.release(), platform.version()
    if read(root / "sys/kernel/realtime") == "1" or "PREEMPT_RT" in version:
        return Finding("kernel", "pass", f"{release}, PREEMPT_RT")
    chosen = read(root / "sys/kernel/debug/sched/preempt")
    if "(" in chosen:
        model = f"PREEMPT_DYNAMIC, running as {chosen.split('(')[1].split(')')[0]}"
    elif "PREEMPT_DYNAMIC" in version:
        model = "PREEMPT_DYNAMIC"
    elif "PREEMPT" in version:
        model = "PREEMPT"
    else:
        model = "no full preemption"
    return Finding(
        "kernel",
        "warn",
        f"{release}, {model}",
        "use a PREEMPT_RT kernel for hardware; `hil latency --load all` shows what this one does",
    )


def scheduler(config: Config) -> Finding:
    """Try the loop's priority, for an instant."""
    wanted = config.loop.priority
    if config.loop.realtime == "off":
        return Finding("scheduler", "pass", 'not asked for (loop.realtime = "off")')
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


def throttling(config: Config, root: Path = _ROOT) -> Finding:
    """Judge the share of time that real-time threads may take: a spinning loop takes all of it."""
    runtime_us = read(root / "proc/sys/kernel/sched_rt_runtime_us")
    period_us = read(root / "proc/sys/kernel/sched_rt_period_us")
    found = f"{runtime_us or '?'} of {period_us or '?'} us for real-time threads"
    if runtime_us in ("-1", period_us, ""):
        return Finding("rt throttling", "pass", "off" if runtime_us else "not visible")
    if config.loop.spin and config.loop.realtime != "off":
        remedy = "sysctl -w kernel.sched_rt_runtime_us=-1, or loop.spin = false"
        return Finding("rt throttling", "warn", f"{found}; loop.spin takes more", remedy)
    return Finding("rt throttling", "pass", found)


def memlock(config: Config) -> Finding:
    """Judge the limit of locked memory."""
    if config.loop.realtime == "off":
        return Finding("memlock", "pass", 'not asked for (loop.realtime = "off")')
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


def _may_use(cpu: int) -> bool:
    """Tell whether a thread can be put on a core, even one it is kept off by default."""
    before = os.sched_getaffinity(0)
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError:
        return False
    os.sched_setaffinity(0, before)
    return True


def cores(config: Config) -> Finding:
    """Judge how many cores there are, and whether the loop's is one of them."""
    usable = os.sched_getaffinity(0)
    cpu = config.loop.cpu
    if cpu is not None and not _may_use(cpu):
        return Finding("cores", "fail", f"core {cpu} is not among {sorted(usable)}", "set loop.cpu")
    if len(usable) < 2:
        return Finding("cores", "warn", "1 core", "give the loop a core of its own")
    return Finding("cores", "pass", f"{len(usable)} usable")


def isolation(config: Config, root: Path = _ROOT) -> Finding:
    """Judge whether the scheduler keeps other work off the loop's core."""
    shown = read(root / "sys/devices/system/cpu/isolated")
    cpu = config.loop.cpu
    if cpu is None:
        free = sorted(parse_cpus(shown))
        if not free:
            return Finding("isolated cores", "pass", "none, and loop.cpu is not set")
        remedy = f"set loop.cpu = {free[0]}"
        return Finding("isolated cores", "warn", f"{shown}, and loop.cpu is not set", remedy)
    if cpu in parse_cpus(shown):
        return Finding("isolated cores", "pass", f"{shown}, core {cpu} of the loop among them")
    remedy = f"boot with isolcpus={cpu} nohz_full={cpu} rcu_nocbs={cpu}"
    return Finding("isolated cores", "warn", f"core {cpu} of the loop is not isolated", remedy)


def interrupts(config: Config, root: Path = _ROOT) -> Finding:
    """Find the interrupts that are served on the loop's core."""
    cpu, name = config.loop.cpu, "irq affinity"
    if cpu is None:
        return Finding(name, "pass", "loop.cpu is not set: no core to keep interrupts from")
    numbers = []
    for folder in (root / "proc/irq").glob("[0-9]*"):
        served = read(folder / "effective_affinity_list") or read(folder / "smp_affinity_list")
        if cpu in parse_cpus(served) and any(path.is_dir() for path in _entries(folder)):
            numbers.append(int(folder.name))
    if not numbers:
        return Finding(name, "pass", f"no device interrupt on core {cpu}")
    shown = ", ".join(str(number) for number in sorted(numbers)[:12])
    others = ",".join(str(core) for core in sorted(os.sched_getaffinity(0) - {cpu})) or "OTHERS"
    remedy = f"echo {others} > /proc/irq/N/smp_affinity_list for each (stop irqbalance first)"
    return Finding(name, "warn", f"{len(numbers)} on core {cpu}: {shown}", remedy)


def _entries(folder: Path) -> list[Path]:
    """A directory in an interrupt's folder names the device that uses it."""
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def governor(config: Config, root: Path = _ROOT) -> Finding:
    """Judge the frequency governors of the loop's core, or of all."""
    cpus = root / "sys/devices/system/cpu"
    pattern = "cpu[0-9]*" if config.loop.cpu is None else f"cpu{config.loop.cpu}"
    found = {read(path / "cpufreq/scaling_governor") for path in cpus.glob(pattern)} - {""}
    if found <= {"performance"}:
        shown = "performance" if found else "no frequency scaling visible"
        return Finding("governor", "pass", shown)
    return Finding(
        "governor", "warn", ", ".join(sorted(found)), "cpupower frequency-set -g performance"
    )


def clock(config: Config, root: Path = _ROOT) -> Finding:
    """Judge the clock source."""
    del config
    folder = root / "sys/devices/system/clocksource/clocksource0"
    source = read(folder / "current_clocksource")
    if source in _FAST_CLOCKS:
        return Finding("clock source", "pass", source or "unknown")
    available = read(folder / "available_clocksource").split()
    better = next((name for name in available if name in _FAST_CLOCKS), None)
    remedy = f"boot with clocksource={better}" if better else "find out why there is no tsc: dmesg"
    return Finding("clock source", "warn", f"{source}, microseconds per reading", remedy)


HOST_CHECKS: tuple[Callable[[Config], Finding], ...] = (
    interpreter,
    kernel,
    scheduler,
    throttling,
    memlock,
    cores,
    isolation,
    interrupts,
    governor,
    clock,
)
"""Every check of the host, in the order shown."""


def parse_cpus(text: str) -> set[int]:
    """Return the cores that a list such as `0,2-3` names; what is no list names none."""
    found: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if first.isdigit() and (last or first).isdigit():
            found.update(range(int(first), int(last or first) + 1))
    return found


def read(path: Path) -> str:
    """Return a file's text without white space around it, empty if it cannot be read."""
    try:
        return path.read_text(encoding="ascii").strip()
    except (OSError, ValueError):
        return ""
