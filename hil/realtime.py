"""What the operating system gives a real-time thread: scheduler, memory, timer, accounting."""

import ctypes
import errno
import gc
import os
import resource
import signal
from collections.abc import Callable
from dataclasses import dataclass
from time import clock_gettime_ns

from hil.config import LoopSettings
from hil.errors import HilError

CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1
_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_libc = ctypes.CDLL(None, use_errno=True)


class RealtimeError(HilError):
    """Real time was asked for and the system did not grant it."""


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


def now_ns() -> int:
    """CLOCK_MONOTONIC in nanoseconds."""
    return clock_gettime_ns(CLOCK_MONOTONIC)


class Sleeper:
    """Sleeps until absolute instants of CLOCK_MONOTONIC (`clock_nanosleep`, TIMER_ABSTIME)."""

    def __init__(self) -> None:
        self._time = _Timespec()
        self._reference = ctypes.byref(self._time)
        self._sleep = _libc.clock_nanosleep

    def until(self, t_ns: int) -> None:
        """Return at `t_ns`, or as soon after it as the scheduler allows, whatever signals come."""
        self._time.tv_sec, self._time.tv_nsec = divmod(t_ns, 1_000_000_000)
        while self._sleep(CLOCK_MONOTONIC, _TIMER_ABSTIME, self._reference, None) == errno.EINTR:
            pass


def spin_until(t_ns: int) -> None:
    """Return at `t_ns` without having given the core away."""
    while clock_gettime_ns(CLOCK_MONOTONIC) < t_ns:
        pass


def make_sleeper(*, is_spinning: bool) -> Callable[[int], None]:
    """Return what waits until an instant of CLOCK_MONOTONIC: asleep, or by looking at the clock."""
    return spin_until if is_spinning else Sleeper().until


@dataclass(frozen=True, slots=True)
class Granted:
    """What real-time set-up obtained; `missing` says in words what it did not."""

    scheduler: str
    memory_locked: bool
    missing: tuple[str, ...]


def make_realtime(settings: LoopSettings) -> Granted:
    """Give the calling thread the configured scheduler, core and locked memory.

    Raises:
        RealtimeError: If something is not granted and `realtime` is `required`. The message names
            it and the remedy.
    """
    missing: list[str] = []
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if settings.cpu is not None:
        _pin(settings.cpu, missing)
    if settings.realtime == "off":
        return Granted("SCHED_OTHER", memory_locked=False, missing=tuple(missing))
    is_fifo = _use_fifo(settings.priority, missing)
    is_locked = _lock_memory(missing)
    if missing and settings.realtime == "required":
        raise RealtimeError(
            f"real time is required but not granted: {'; '.join(missing)}; grant it (see "
            'README, "Real-time rights") or set loop.realtime = "best_effort"'
        )
    return Granted("SCHED_FIFO" if is_fifo else "SCHED_OTHER", is_locked, tuple(missing))


def _pin(cpu: int, missing: list[str]) -> None:
    try:
        os.sched_setaffinity(0, {cpu})
    except OSError as error:
        missing.append(f"core {cpu} cannot be used ({error.strerror})")


def _use_fifo(priority: int, missing: list[str]) -> bool:
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except OSError as error:
        missing.append(f"SCHED_FIFO priority {priority} ({error.strerror}; limit rtprio)")
        return False
    return True


def _lock_memory(missing: list[str]) -> bool:
    if _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE) == 0:
        return True
    reason = os.strerror(ctypes.get_errno())
    missing.append(f"locked memory ({reason}; limit memlock)")
    return False


def freeze_garbage() -> None:
    """Stop the garbage collector: what exists stays, and the loop makes no reference cycles."""
    gc.collect()
    gc.freeze()
    gc.disable()


def die_with_parent(parent_pid: int) -> None:
    """Have SIGTERM sent to this process when its parent is gone, or exit if it already is.

    Args:
        parent_pid: The parent as it was at start.
    """
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)
    if os.getppid() != parent_pid:
        raise SystemExit(1)


class Usage:
    """Page faults and context switches of this process since the object was made."""

    def __init__(self) -> None:
        self._start = _usage()

    def since_start(self) -> dict[str, int]:
        """Return minor and major faults, voluntary and involuntary switches, and resident pages.

        `resident_kB` is the most that was ever resident: what grows in a run shows there.
        """
        now = _usage()
        counts = {name: count - self._start[name] for name, count in now.items()}
        return {**counts, "resident_kB": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss}


def _usage() -> dict[str, int]:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return {
        "minor_faults": used.ru_minflt,
        "major_faults": used.ru_majflt,
        "voluntary_switches": used.ru_nvcsw,
        "involuntary_switches": used.ru_nivcsw,
    }
