"""The recorder process: writes what the loop left in shared memory to MCAP files.

Its places in the rings move on only when what was read is in the kernel's hands: a recorder that
is killed leaves a readable file, and its successor's file begins where that one ends, or a little
before. What ends a recording (a full disk, too little free space) is told once, and the arm goes
on.
"""

import json
import signal
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from time import sleep
from typing import Any
from zlib import crc32

from hil.black_box import BlackBox
from hil.errors import HilError
from hil.process import outlast_loop
from hil.realtime import die_with_parent, now_ns
from hil.recording_writer import Part, RecordingError, RecordingWriter
from hil.retention import MB, Retention
from hil.shared import SharedMemory

DRAIN_EVERY_S = 0.05
"""Half of what a kill of all processes may cost."""
AT_ONCE = 4000
CLEAN_UP_EVERY_NS = 1_000_000_000


class Recorder:
    """Drains samples, bus frames and events into the files of one run.

    Args:
        shared: The daemon's shared memory.
        first: File of the run's first part; one that exists is replaced.
        series: Name of the run in its parts, see `hil.recording_writer.Part`.

    Attributes:
        clean_up_every_ns: How often the disk budget is looked after.

    Raises:
        RecordingError: If the file cannot be created.
    """

    def __init__(self, shared: SharedMemory, first: Path, series: str) -> None:
        self._shared = shared
        self._first = first
        self._series = series
        self._settings = shared.config.recording
        self._retention = Retention(shared.config, first)
        self._samples = shared.reader("samples", "recorder")
        self._frames = shared.reader("frames", "recorder")
        self._events = shared.reader("events", "recorder")
        self._writer: RecordingWriter | None = None
        self._black_box = BlackBox(shared, first)
        self._cycle = 0
        self._began_ns = 0
        self.clean_up_every_ns = CLEAN_UP_EVERY_NS
        self._clean_up_ns = 0
        lack = self._retention.lack_of_space()
        if lack:
            self._stop(lack)
            return
        self._begin()
        if self._part.number > 1:
            self._note("continued", file=self._part.path(first).name)

    @property
    def _part(self) -> Part:
        """The part that was begun last."""
        return Part(self._series, self._shared.recording_part)

    def drain(self) -> None:
        """Write everything that is new; end the recording if that is not possible."""
        writer = self._writer
        try:
            if writer is not None:
                self._write(writer)
                self._keep_within_limits(writer)
        except RecordingError as error:
            self._stop(str(error))
        if self._writer is None:
            for reader in (self._samples, self._frames, self._events):
                reader.skip()
                reader.commit()

    def _write(self, writer: RecordingWriter) -> None:
        while records := self._samples.read(AT_ONCE):
            rows = self._shared.layout.decode(records)
            self._cycle = int(rows["cycle"][-1])
            for t_ns, seq, record in zip(
                rows["t_ns"].tolist(), rows["seq"].tolist(), records, strict=True
            ):
                writer.add_sample(t_ns, seq, record)
        while records := self._frames.read(AT_ONCE):
            log = b"".join(records)
            if log:
                writer.add_bus_log(self._shared.frame_layout.first_t_ns(log), log)
        for event in self._events.read_json(AT_ONCE):
            t_ns, cycle, kind = event.pop("t_ns"), event.pop("cycle"), event.pop("kind")
            writer.add_event(t_ns, cycle, kind, event)
            if kind == "input" and event["command"]["verb"] == "trajectory":
                self._add_trajectory(writer, t_ns, event["command"])
        writer.flush()
        for reader in (self._samples, self._frames, self._events):
            reader.commit()

    def _add_trajectory(
        self, writer: RecordingWriter, t_ns: int, command: Mapping[str, Any]
    ) -> None:
        """Keep the reference, unless its slot has been written anew: then its CRC tells."""
        size = command["samples"] * self._shared.config.joints * 3 * 8
        rows = bytes(self._shared.slot(command["slot"])[:size])
        if crc32(rows) == command["crc32"]:
            writer.add_trajectory(t_ns, command["crc32"], rows)

    # --- parts and limits ----------------------------------------------------------------------

    def _begin(self) -> None:
        config, number = self._shared.config, self._shared.recording_part + 1
        part = Part(self._series, number)
        self._writer = RecordingWriter(
            part.path(self._first), config.model_dump_json(), config.joints, False, part
        )
        self._shared.recording_part = number  # a successor begins with the next one
        self._began_ns = now_ns()

    def _keep_within_limits(self, writer: RecordingWriter) -> None:
        at_ns = now_ns()
        age_s = (at_ns - self._began_ns) / 1e9
        if (
            writer.size_bytes >= self._settings.max_size_MB * MB
            or age_s >= self._settings.max_age_s
        ):
            following = Part(self._series, self._part.number + 1).path(self._first)
            self._note("continued", file=following.name)
            writer.close()
            self._begin()
        if at_ns >= self._clean_up_ns:
            self._clean_up_ns = at_ns + self.clean_up_every_ns
            for path in self._retention.remove_oldest(self._part):
                self._note("removed", file=path.name)
        lack = self._retention.lack_of_space()
        if lack:
            self._stop(lack)

    def _stop(self, reason: str) -> None:
        """End the recording for good, say so once, and let the arm go on."""
        with suppress(RecordingError):
            self._note("stopped", reason=reason)
        writer, self._writer = self._writer, None
        if writer is not None:
            with suppress(RecordingError):
                writer.close()
        _tell(f"recording has stopped: {reason}")

    def _keep_black_box(self, step: Callable[[], Path | None]) -> None:
        """Let the black box look; what it cannot write is told, and the recording goes on."""
        try:
            path = step()
        except RecordingError as error:
            _tell(f"no black box: {error}")
            return
        if path is not None:
            self._note("black_box", file=path.name)

    def _note(self, action: str, **detail: str) -> None:
        """Tell clients and the recording itself what becomes of it."""
        t_ns, detail = now_ns(), {"action": action, **detail}
        note = {"t_ns": t_ns, "cycle": self._cycle, "kind": "recording", **detail}
        self._shared.notes.append(json.dumps(note).encode())
        if self._writer is not None:
            self._writer.add_event(t_ns, self._cycle, "recording", detail)

    # --- the process's life --------------------------------------------------------------------

    def run(self, parent_pid: int) -> None:
        """Drain until SIGTERM; without supervisor, until the loop has ended."""
        signals: list[int] = []
        signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})  # it waited for the handler
        while not signals:
            self._shared.beat("recorder", now_ns())
            self.drain()
            self._keep_black_box(self._black_box.look)
            sleep(DRAIN_EVERY_S)
        outlast_loop(self._shared, parent_pid, self.drain)
        self.drain()
        self._keep_black_box(self._black_box.close)
        lost = {
            "samples": self._samples.lost,
            "frames": self._frames.lost,
            "events": self._events.lost,
        }
        if any(lost.values()):
            _tell(f"the recording misses {lost}")

    def close(self) -> None:
        """Close the file; remove it if it holds nothing.

        Raises:
            RecordingError: If the file cannot be written.
        """
        writer, self._writer = self._writer, None
        if writer is None:
            return
        writer.close()
        if writer.is_empty or self._samples.place == 0:  # the loop never came to a cycle
            writer.path.unlink(missing_ok=True)


def _tell(line: str) -> None:
    print(f"hil: {line}", file=sys.stderr)  # noqa: T201 - the line the user is promised


def main(shared_fd: int, parent_pid: int, path: str, series: str) -> int:
    """Entry of the recorder process.

    Returns:
        0 after an orderly end, 1 with one line on stderr otherwise.
    """
    die_with_parent(parent_pid)
    shared = SharedMemory(shared_fd)
    try:
        recorder = Recorder(shared, Path(path), series)
        try:
            recorder.run(parent_pid)
        finally:
            recorder.close()
    except HilError as error:
        _tell(str(error))
        return 1
    return 0
