"""The black box: around every trip, a file of its own with what led to it and what followed.

It holds samples, bus frames and events from `BEFORE_S` before the trip to `AFTER_S` after it, as a
recording does; `hil report`, `hil export` and `hil diff` read it. It is taken from the rings in
shared memory, so that it needs nothing of the recording beside it, and it is kept when old
recordings are removed.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from hil.realtime import now_ns
from hil.recording_writer import RecordingError, RecordingWriter
from hil.shared import Ring, SharedMemory

BEFORE_S: Final = 10.0
AFTER_S: Final = 2.0
_AT_ONCE: Final = 500
_LATCHED: Final = ("SOFT_STOP", "TORQUE_OFF")


class BlackBox:
    """Watches the events of one daemon for trips.

    A trip during the seconds after another belongs to the same box.

    Args:
        shared: The daemon's shared memory.
        recording: File beside which boxes are put: `NAME-trip-CYCLE.mcap`.
    """

    def __init__(self, shared: SharedMemory, recording: Path) -> None:
        self._shared = shared
        self._recording = recording
        reader = self._reader = shared.follower("events")
        reader.place = max(0, reader.place - shared.events.slots + 1)  # of a killed predecessor
        self._events: deque[dict[str, Any]] = deque(maxlen=shared.events.slots)
        self._trip: dict[str, Any] | None = None

    def look(self) -> Path | None:
        """Take note of new events; write the box when the time after a trip is over.

        Returns:
            The file that was written, None if there was nothing to write.

        Raises:
            RecordingError: If it cannot be written. The trip is not tried again.
        """
        while events := self._reader.read_json(_AT_ONCE):
            for event in events:
                self._events.append(event)
                if self._trip is None and is_trip(event) and not self._path(event).exists():
                    self._trip = event
        if self._trip is None or now_ns() < self._trip["t_ns"] + AFTER_S * 1e9:
            return None
        return self._write()

    def close(self) -> Path | None:
        """The run is over: write what there is of a box that still waits for its end.

        Raises:
            RecordingError: As for `look`.
        """
        self.look()
        return None if self._trip is None else self._write()

    def _path(self, trip: Mapping[str, Any]) -> Path:
        return self._recording.with_stem(f"{self._recording.stem}-trip-{trip['cycle']}")

    def _write(self) -> Path | None:
        trip, self._trip = self._trip, None
        if trip is None:
            return None
        first_ns = trip["t_ns"] - round(BEFORE_S * 1e9)
        last_ns = trip["t_ns"] + round(AFTER_S * 1e9)
        config = self._shared.config
        path = self._path(trip)
        partial = path.with_suffix(".partial")
        with RecordingWriter(partial, config.model_dump_json(), config.joints, False) as writer:
            cause = {"trip": trip.get("code", trip["kind"]), "recording": self._recording.name}
            writer.add_event(trip["t_ns"], trip["cycle"], "black_box", cause)
            self._add_samples(writer, first_ns, last_ns)
            self._add_frames(writer, first_ns, last_ns)
            self._add_events(writer, first_ns, last_ns)
        try:
            partial.rename(path)
        except OSError as error:
            raise RecordingError(f"cannot write {path}: {error.strerror}") from error
        return path

    def _add_samples(self, writer: RecordingWriter, first_ns: int, last_ns: int) -> None:
        layout = self._shared.layout
        for records in _blocks(self._shared.samples):
            rows = layout.decode(records)
            columns = rows["t_ns"].tolist(), rows["seq"].tolist()
            for t_ns, seq, record in zip(*columns, records, strict=True):
                if first_ns <= t_ns <= last_ns:
                    writer.add_sample(t_ns, seq, record)

    def _add_frames(self, writer: RecordingWriter, first_ns: int, last_ns: int) -> None:
        first_of = self._shared.frame_layout.first_t_ns
        for records in _blocks(self._shared.frames):
            logs = [log for log in records if log and first_ns <= first_of(log) <= last_ns]
            if logs:
                writer.add_bus_log(first_of(logs[0]), b"".join(logs))

    def _add_events(self, writer: RecordingWriter, first_ns: int, last_ns: int) -> None:
        for event in self._events:
            if first_ns <= event["t_ns"] <= last_ns:
                detail = {k: v for k, v in event.items() if k not in ("t_ns", "cycle", "kind")}
                writer.add_event(event["t_ns"], event["cycle"], event["kind"], detail)


def is_trip(event: Mapping[str, Any]) -> bool:
    """Tell whether an event says that a fault was latched, or an emergency stop."""
    if event["kind"] == "fault":
        return event.get("reaction") in _LATCHED
    return event["kind"] == "state" and event.get("to") == "ESTOP"


def _blocks(ring: Ring) -> Iterator[list[bytes]]:
    """Return what a ring still holds, oldest first, some records at a time."""
    head = ring.head
    for start in range(max(0, head - ring.slots + 1), head, _AT_ONCE):
        numbers = range(start, min(head, start + _AT_ONCE))
        records = [record for record in map(ring.get, numbers) if record is not None]
        if records:
            yield records
