"""`hil run`: starts loop, gateway and recorder, watches them, and ends them in the right order."""

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep
from typing import Any
from uuid import uuid4

from hil.config import Config
from hil.errors import HilError
from hil.notify import Watchdog, notify
from hil.shared import SharedMemory

WATCH_EVERY_S = 0.02
LOOP_SILENCE_S = 1.0
"""A loop that has not shown itself for this long no longer feeds the service's watchdog."""
START_TIMEOUT_S = 30.0
START_SAMPLES = 20
"""Cycles after which the amplifiers' state is known."""
STOP_MARGIN_S = 3.0
RECORDER_MARGIN_S = 10.0
"""One that has just been started has to come up before it can write and end."""
RESTART_PAUSE_S = 0.2
RESTART_PAUSE_MAX_S = 10.0
STEADY_S = 10.0
"""A child that lasted this long is restarted as promptly as the first time."""

OnReady = Callable[[Mapping[str, Any]], None]
"""Called once with the loop's status."""


class RunError(HilError):
    """The daemon could not start, or one of its processes failed."""


@contextmanager
def sole_daemon(arm: str) -> Iterator[None]:
    """Hold the arm's lock on this host.

    Raises:
        RunError: If another daemon holds it.
    """
    path = Path(tempfile.gettempdir()) / f"hil-{arm}.lock"
    try:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
    except OSError as error:
        raise RunError(f"cannot lock arm {arm!r}: {path}: {error.strerror}") from error
    with open(fd, "r+") as file:  # noqa: PTH123 - a descriptor
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            pid = file.read().strip() or "unknown"
            raise RunError(
                f"arm {arm!r} already has a daemon on this host (pid {pid}); stop it, or give this "
                "one another arm.name"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


@dataclass(slots=True)
class _Child:
    process: "subprocess.Popen[bytes]"
    started_s: float
    failures: int = 0
    restart_s: float | None = None

    @property
    def status(self) -> int | None:
        """Exit status, negative for a signal; None while it runs."""
        return self.process.poll()


class Supervisor:
    """The processes of one daemon.

    The loop is never restarted: when it ends, the daemon ends, torque being off. Gateway and
    recorder are restarted when they die; the loop does not notice.
    """

    def __init__(self, config: Config, recording: Path | None) -> None:
        self._shared = SharedMemory.create(config)
        self._config = config
        self._recording = recording
        self._series = uuid4().hex
        self._children: dict[str, _Child] = {}
        self._is_ended = False

    def run(self, on_ready: OnReady) -> int:
        """Run until SIGINT or SIGTERM, or until the loop ends by itself.

        Args:
            on_ready: Called when the loop is cycling and the gateway can be reached.

        Returns:
            0 after an orderly stop, 1 if the daemon could not start or the loop failed; one line
            on stderr has said why.

        Raises:
            RunError: If the children do not come up in time. They have been ended.
        """
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        try:
            self._spawn("loop")
            self._spawn("gateway")
            if self._recording is not None:
                self._spawn("recorder")
            status = self._await_start()
            if status is not None:
                return status
            on_ready(self._shared.status())
            notify("READY=1")
            return self._watch()
        finally:
            notify("STOPPING=1")
            self._stop_all()

    # --- children ----------------------------------------------------------------------------

    def _spawn(self, name: str, failures: int = 0) -> None:
        command = [sys.executable, "-m", "hil.process", name]
        command += [str(self._shared.fd), str(os.getpid())]
        if name == "recorder":
            command += [str(self._recording), self._series]
        held = {signal.SIGTERM} if name == "recorder" else set()  # what the rings hold is written
        before = signal.pthread_sigmask(signal.SIG_BLOCK, held)  # even by one that just starts
        process = subprocess.Popen(  # noqa: S603 - our own module and arguments
            command, pass_fds=[self._shared.fd], start_new_session=True
        )
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
        self._children[name] = _Child(process, monotonic(), failures)

    def _await_start(self) -> int | None:
        """Wait until all children show themselves.

        Returns:
            The daemon's exit status if it is over before it has begun, else None.

        Raises:
            RunError: If they do not in time.
        """
        deadline_s = monotonic() + START_TIMEOUT_S
        while not self._is_ended:
            silent = [name for name in self._children if not self._is_up(name)]
            if not silent:
                return None
            for name, child in self._children.items():
                if child.status is not None:
                    self._explain(name, child.status)
                    return 1
            if monotonic() > deadline_s:
                raise RunError(f"the {silent[0]} does not come up within {START_TIMEOUT_S:g} s")
            sleep(WATCH_EVERY_S)
        return self._stop_loop()

    def _is_up(self, name: str) -> bool:
        if name == "loop":
            cycles: int = self._shared.status().get("samples", 0)
            return cycles >= START_SAMPLES
        return self._shared.last_beat(name) > 0

    def _watch(self) -> int:
        """Return the daemon's exit status when it is over."""
        loop, watchdog = self._children["loop"], Watchdog()
        while not self._is_ended:
            if loop.status is not None:
                self._explain("loop", loop.status)
                return 1
            if self._shared.is_alive("loop", LOOP_SILENCE_S):
                watchdog.beat()
            self._restart_dead()
            sleep(WATCH_EVERY_S)
        return self._stop_loop()

    def _explain(self, name: str, status: int) -> None:
        """Say why a child ended, unless it has said so itself."""
        if status > 0:
            return
        how = f"was killed ({_signal_name(status)})" if status else "ended without being asked to"
        if name == "loop":
            _tell(
                f"the control loop {how}; the amplifiers' watchdogs remove torque; nothing is "
                "enabled again by itself"
            )
        else:
            _tell(f"the {name} {how}")

    def _restart_dead(self) -> None:
        for name, child in list(self._children.items()):
            if name == "loop" or child.status is None:
                continue
            now_s = monotonic()
            if child.restart_s is None:
                if now_s - child.started_s > STEADY_S:
                    child.failures = 0
                pause_s = min(RESTART_PAUSE_S * 2**child.failures, RESTART_PAUSE_MAX_S)
                child.restart_s = now_s + pause_s
                status = child.status
                cause = _signal_name(status) if status < 0 else f"status {status}"
                _tell(f"the {name} ended ({cause}); restarting it in {pause_s:g} s")
            elif now_s >= child.restart_s:
                self._spawn(name, child.failures + 1)

    # --- the end -----------------------------------------------------------------------------

    def _stop_loop(self) -> int:
        """Ask the loop for an orderly end and wait for it."""
        loop = self._children["loop"].process
        loop.terminate()
        allowed_s = self._config.controller.stop_time_s + STOP_MARGIN_S
        try:
            status = loop.wait(allowed_s)
        except subprocess.TimeoutExpired:
            _tell("the control loop does not end; killing it")
            return 1
        return 0 if status in (0, -signal.SIGTERM) else 1  # by SIGTERM: before its first cycle

    def _stop_all(self) -> None:
        """End the loop first, so that gateway and recorder see its last samples."""
        for name in ("loop", "gateway", "recorder"):
            if name not in self._children:
                continue
            if name == "recorder" and (self._children[name].status or 0) < 0:
                self._spawn(name)  # killed just before: the rings hold what it has not written
            process = self._children[name].process
            if process.poll() is None:
                process.terminate()
            try:
                process.wait(STOP_MARGIN_S if name != "recorder" else RECORDER_MARGIN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _end(self, *_: object) -> None:
        self._is_ended = True


def _signal_name(status: int) -> str:
    try:
        return signal.Signals(-status).name
    except ValueError:  # a real-time signal has no name
        return f"signal {-status}"


def _tell(line: str) -> None:
    print(f"hil: {line}", file=sys.stderr)  # noqa: T201 - the line the user is promised
