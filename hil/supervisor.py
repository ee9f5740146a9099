"""`hil run`: starts loop, gateway and recorder, watches them, and ends them in the right order."""

import fcntl
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic, sleep

from hil.config import Config
from hil.errors import HilError
from hil.shared import SharedMemory

WATCH_EVERY_S = 0.02
START_TIMEOUT_S = 15.0
STOP_MARGIN_S = 3.0
RESTART_PAUSE_S = 0.2


class RunError(HilError):
    """The daemon could not start, or one of its processes failed."""


@contextmanager
def sole_daemon(arm: str) -> Iterator[None]:
    """Hold the arm's lock on this host.

    Raises:
        RunError: If another daemon holds it.
    """
    path = Path(tempfile.gettempdir()) / f"hil-{arm}.lock"
    with path.open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.seek(0)
            pid = file.read().strip() or "unknown"
            raise RunError(
                f"arm {arm!r} already has a daemon on this host (pid {pid}); stop it, or give this "
                "one another arm.name"
            ) from None
        file.truncate(0)
        file.write(f"{os.getpid()}\n")
        file.flush()
        yield


class Supervisor:
    """The processes of one daemon.

    The loop is never restarted: when it ends, the daemon ends, torque being off. Gateway and
    recorder are restarted when they die; the loop does not notice.
    """

    def __init__(self, config: Config, recording: Path | None) -> None:
        self._shared = SharedMemory.create(config)
        self._config = config
        self._recording = recording
        self._restarts = 0
        self._children: dict[str, subprocess.Popen[bytes]] = {}
        self._is_ended = False

    def run(self, on_ready: Callable[[], None] | None = None) -> int:
        """Run until SIGINT or SIGTERM, or until the loop ends by itself.

        Args:
            on_ready: Called once when the loop is cycling and the gateway can be reached.

        Returns:
            0 after an orderly stop, 1 if the loop failed.
        """
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._end)
        try:
            self._spawn("loop")
            self._spawn("gateway")
            if self._recording is not None:
                self._spawn("recorder", str(self._recording))
            if self._await_start() and on_ready is not None:
                on_ready()
            return self._watch()
        finally:
            self._stop_all()

    def _spawn(self, name: str, *arguments: str) -> None:
        command = [sys.executable, "-m", "hil.process", name]
        command += [str(self._shared.fd), str(os.getpid()), *arguments]
        self._children[name] = subprocess.Popen(  # noqa: S603 - our own module and arguments
            command, pass_fds=[self._shared.fd], start_new_session=True
        )

    def _await_start(self) -> bool:
        deadline_s = monotonic() + START_TIMEOUT_S
        while monotonic() < deadline_s and not self._is_ended:
            if self._shared.last_beat("loop") and self._shared.last_beat("gateway"):
                return True
            if any(child.poll() is not None for child in self._children.values()):
                return False
            sleep(WATCH_EVERY_S)
        return False

    def _watch(self) -> int:
        """Return the daemon's exit status when it is over."""
        has_started = bool(self._shared.last_beat("gateway"))
        while not self._is_ended:
            if self._children["loop"].poll() is not None:
                return self._report_loop()
            if not has_started and self._children["gateway"].poll() is not None:
                return 1  # it has said why: endpoint in use, for example
            has_started = has_started or bool(self._shared.last_beat("gateway"))
            self._restart_dead()
            sleep(WATCH_EVERY_S)
        return self._stop_loop()

    def _report_loop(self) -> int:
        status = self._children["loop"].returncode
        if status < 0:
            name = signal.Signals(-status).name
            print(  # noqa: T201 - the line the user is promised
                f"hil: the control loop was killed ({name}); the amplifiers' watchdogs remove "
                "torque; nothing is enabled again by itself",
                file=sys.stderr,
            )
        return 1

    def _restart_dead(self) -> None:
        for name in ("gateway", "recorder"):
            child = self._children.get(name)
            if child is None or child.poll() is None:
                continue
            print(  # noqa: T201 - told to the user
                f"hil: the {name} ended (status {child.returncode}); restarting it", file=sys.stderr
            )
            sleep(RESTART_PAUSE_S)
            self._spawn(name, *self._next_recording() if name == "recorder" else ())

    def _next_recording(self) -> tuple[str]:
        """A restarted recorder goes on in a file of its own: the first stays as it is."""
        assert self._recording is not None  # noqa: S101 - there is a recorder
        self._restarts += 1
        path = self._recording
        return (str(path.with_stem(f"{path.stem}-{self._restarts + 1}")),)

    def _stop_loop(self) -> int:
        """Ask the loop for an orderly end and wait for it."""
        loop = self._children["loop"]
        loop.terminate()
        allowed_s = self._config.controller.limits.stop_timeout_s + STOP_MARGIN_S
        try:
            return 0 if loop.wait(allowed_s) == 0 else 1
        except subprocess.TimeoutExpired:
            print("hil: the control loop does not end; killing it", file=sys.stderr)  # noqa: T201
            return 1

    def _stop_all(self) -> None:
        """End the loop first, so that gateway and recorder see its last samples."""
        for name in ("loop", "gateway", "recorder"):
            child = self._children.get(name)
            if child is None:
                continue
            if child.poll() is None:
                child.terminate()
            try:
                child.wait(STOP_MARGIN_S)
            except subprocess.TimeoutExpired:
                child.kill()
                child.wait()

    def _end(self, *_: object) -> None:
        self._is_ended = True
