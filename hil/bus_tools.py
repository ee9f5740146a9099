"""Tools for any bus: follow it, log it, play a log back."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from math import inf
from time import monotonic, sleep, time

from drivers.bus import Bus, split_address
from drivers.decoder import FrameDecoder, frame_label
from drivers.frame import ERR_FLAG, unpack_header
from hil.errors import HilError

POLL_S = 0.05
"""Longest time between two looks at whether to end."""
LEFT_OVER_FRAMES = 10_000
"""Frames that wait to be read at the end and are taken along, at most."""
QUEUE_TIMEOUT_S = 1.0
"""A bus that takes no frame for this long is not working."""


class BusToolError(HilError):
    """A bus tool cannot go on; the message says why."""


def is_virtual(address: str) -> bool:
    """Tell whether a bus exists in software only, so that nothing on it can move.

    Raises:
        BusAddressError: If the address cannot be understood.
    """
    scheme, rest = split_address(address)
    if scheme == "socketcan":
        return rest.startswith(("vcan", "vxcan"))
    return scheme == "unix" or (scheme == "python-can" and rest.startswith("virtual:"))


def frames_of(bus: Bus, is_ended: Callable[[], bool]) -> Iterator[tuple[float, bytes] | None]:
    """Yield (seconds since the epoch, frame) as frames arrive, and None while nothing does.

    At the end come the frames that have arrived by then.

    Args:
        bus: An open bus.
        is_ended: Asked between frames, at least every 50 ms.

    Raises:
        BusError: If the bus is gone.
    """
    while not is_ended():
        frame = bus.recv(POLL_S)
        yield None if frame is None else (time(), frame)
    for _ in range(LEFT_OVER_FRAMES):
        frame = bus.recv(0.0)
        if frame is None:
            return
        yield time(), frame


@dataclass(slots=True)
class _Row:
    """What is known of one identifier."""

    count: int = 0
    counted: int = 0
    rate_Hz: float = 0.0
    frame: bytes = b""
    printed_s: float = -inf


@dataclass(slots=True)
class Monitor:
    """Counts the frames of every identifier, and shows the last of each.

    Attributes:
        decoder: Names the fields; None shows bytes.
        interval_s: Shortest time between two lines of one identifier; 0 prints every frame.
        now_s: Clock for the rates.
        frames: Frames taken so far.
    """

    decoder: FrameDecoder | None
    interval_s: float = 0.0
    now_s: Callable[[], float] = monotonic
    frames: int = 0
    _rows: dict[int, _Row] = field(default_factory=dict)
    _refreshed_s: float = 0.0

    def __post_init__(self) -> None:
        self._refreshed_s = self.now_s()

    def take(self, t_s: float, frame: bytes) -> str | None:
        """Count a frame; return its line, or None if its identifier had one a moment ago.

        Args:
            t_s: Seconds since the epoch.
            frame: Record from a bus.
        """
        self.frames += 1
        row = self._rows.setdefault(unpack_header(frame)[0], _Row())
        row.count += 1
        row.frame = frame
        if t_s - row.printed_s < self.interval_s:
            return None
        row.printed_s = t_s
        text = f"  {self.decoder.describe(frame)}" if self.decoder is not None else ""
        return f"({t_s:.6f}) {frame_label(frame):24}{text}".rstrip()

    def table(self) -> str:
        """Return one line per identifier: count, rate since the last table, last frame."""
        now_s = self.now_s()
        passed_s, self._refreshed_s = now_s - self._refreshed_s, now_s
        lines = [f"{'frame':28}{'count':>9}{'Hz':>9}  {self.frames} frames"]
        for _, row in sorted(self._rows.items()):
            row.rate_Hz = (row.count - row.counted) / passed_s if passed_s > 0.0 else 0.0
            row.counted = row.count
            text = self.decoder.describe(row.frame) if self.decoder is not None else ""
            label = frame_label(row.frame)
            lines.append(f"{label:28}{row.count:>9}{row.rate_Hz:>9.1f}  {text}".rstrip())
        return "\n".join(lines)


@dataclass(slots=True)
class Playback:
    """What was played."""

    frames: int = 0
    skipped: int = 0
    """Error reports, which cannot be sent."""
    duration_s: float = 0.0
    late_s: float = 0.0
    """How much later than in the log, relative to the first frame, the latest frame was sent."""


def play(
    bus: Bus,
    log: Iterable[tuple[float, bytes]],
    *,
    is_fast: bool,
    is_ended: Callable[[], bool] = lambda: False,
) -> Playback:
    """Send the frames of a log, at the log's own pace or as fast as the bus takes them.

    Args:
        bus: Where to.
        log: (seconds, record) as `drivers.frame_log.read_log` yields them.
        is_fast: Wait for nothing but room in the bus's queue.
        is_ended: Asked between frames, at least every 50 ms.

    Raises:
        BusToolError: If the bus takes no frames.
        BusError: If it is gone.
    """
    done = Playback()
    start_s = monotonic()
    first_s: float | None = None
    for t_s, frame in log:
        first_s = t_s if first_s is None else first_s
        due_s = start_s + (t_s - first_s)
        if not is_fast:
            _wait_until(due_s, is_ended)
        if is_ended():
            break
        if unpack_header(frame)[0] & ERR_FLAG:
            done.skipped += 1
            continue
        _send(bus, frame)
        done.frames += 1
        done.late_s = max(done.late_s, monotonic() - due_s)
    done.duration_s = monotonic() - start_s
    return done


def _wait_until(due_s: float, is_ended: Callable[[], bool]) -> None:
    while (left_s := due_s - monotonic()) > 0.0 and not is_ended():
        sleep(min(left_s, POLL_S))


def _send(bus: Bus, frame: bytes) -> None:
    deadline_s = monotonic() + QUEUE_TIMEOUT_S
    while not bus.send(frame):
        if monotonic() > deadline_s:
            raise BusToolError(
                f"the bus took no frame for {QUEUE_TIMEOUT_S:g} s (send queue full); "
                "is any other node on it?"
            )
        while bus.recv(0.0) is not None:
            pass
        sleep(1e-3)
