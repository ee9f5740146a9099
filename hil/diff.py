"""Two recordings side by side: are they the same run, and if not, where do they part?"""

import hashlib
from dataclasses import dataclass
from itertools import zip_longest

from drivers.arm_group import split_bus
from hil.recording import Recording
from hil.replay import Difference, first_difference
from hil.telemetry import SENT, LoggedFrame


@dataclass(frozen=True, slots=True)
class Digest:
    """SHA-256 of what a recording holds, its configuration aside."""

    samples: str
    frames: str
    events: str

    @classmethod
    def of(cls, recording: Recording) -> "Digest":
        """Compute it from every sample, frame and event, in the order of the file."""
        frames, events = hashlib.sha256(), hashlib.sha256()
        for frame in recording.frames():
            frames.update(repr(frame).encode())
        for event in recording.events:
            events.update(repr(event).encode())
        samples = hashlib.sha256(recording.samples.tobytes())
        return cls(samples.hexdigest(), frames.hexdigest(), events.hexdigest())


def first_parting(a: Recording, b: Recording, *, with_timing: bool) -> list[Difference]:
    """Return where the samples, the bus frames and the events of two recordings first differ.

    Args:
        a: The one called recorded in the result.
        b: The one called replayed.
        with_timing: Compare instants and durations too, as of two simulated runs.
    """
    found = [_samples(a, b, with_timing), _frames(a, b, with_timing), _events(a, b, with_timing)]
    return [difference for difference in found if difference is not None]


def _samples(a: Recording, b: Recording, with_timing: bool) -> Difference | None:
    if a.joints != b.joints:
        return Difference(0, "joints", str(a.joints), str(b.joints))
    common = min(len(a.samples), len(b.samples))
    ignored = {"ignored": frozenset[str]()} if with_timing else {}
    difference = first_difference(a.samples[:common], b.samples[:common], **ignored)
    if difference is None and len(a.samples) != len(b.samples):
        return Difference(common, "samples", str(len(a.samples)), str(len(b.samples)))
    return difference


def _frames(a: Recording, b: Recording, with_timing: bool) -> Difference | None:
    for number, (x, y) in enumerate(zip_longest(a.frames(), b.frames()), start=1):
        if x is None or y is None or (x if with_timing else x[1:]) != (y if with_timing else y[1:]):
            at_ns = (x or y).t_ns
            source = a if x is not None else b
            return Difference(_cycle_at(source, at_ns), f"bus frame {number}", _tell(x), _tell(y))
    return None


def _tell(frame: LoggedFrame | None) -> str:
    if frame is None:
        return "none"
    bus, way = split_bus(frame.direction)
    where = f" on bus {bus}" if bus > 1 else ""
    return f"{'sent' if way == SENT else 'received'}{where} {frame.frame.hex()}"


def _cycle_at(recording: Recording, t_ns: int) -> int:
    place = int(recording.samples["t_ns"].searchsorted(t_ns, side="right")) - 1
    return int(recording.samples["cycle"][place]) if place >= 0 else -1


def _events(a: Recording, b: Recording, with_timing: bool) -> Difference | None:
    for x, y in zip_longest(a.events, b.events):
        pair = [e and (e.t_ns if with_timing else 0, e.cycle, e.kind, e.detail) for e in (x, y)]
        if pair[0] != pair[1]:
            event = x or y
            told = [f"{e.kind} {e.detail}" if e is not None else "none" for e in (x, y)]
            return Difference(event.cycle, "event", *told)
    return None
