"""The recorder process: writes what the loop left in shared memory to an MCAP file.

Its places in the rings move on only when what was read is in the kernel's hands: a recorder that
is killed leaves a readable file, and its successor's file begins where that one ends, or a little
before.
"""

import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from time import sleep
from typing import Any
from zlib import crc32

from hil.errors import HilError
from hil.process import outlast_loop
from hil.realtime import die_with_parent, now_ns
from hil.recording import RecordingWriter
from hil.shared import SharedMemory

DRAIN_EVERY_S = 0.1
AT_ONCE = 4000


class Recorder:
    """Drains samples, bus frames and events into one recording."""

    def __init__(self, shared: SharedMemory, writer: RecordingWriter) -> None:
        self._shared = shared
        self._writer = writer
        self._samples = shared.reader("samples", "recorder")
        self._frames = shared.reader("frames", "recorder")
        self._events = shared.reader("events", "recorder")

    def drain(self) -> None:
        """Write everything that is new.

        Raises:
            RecordingError: If the file cannot be written.
        """
        while records := self._samples.read(AT_ONCE):
            rows = self._shared.layout.decode(records)
            for t_ns, seq, record in zip(
                rows["t_ns"].tolist(), rows["seq"].tolist(), records, strict=True
            ):
                self._writer.add_sample(t_ns, seq, record)
        while records := self._frames.read(AT_ONCE):
            log = b"".join(records)
            if log:
                self._writer.add_bus_log(self._shared.frame_layout.first_t_ns(log), log)
        for event in self._events.read_json(AT_ONCE):
            t_ns, cycle, kind = event.pop("t_ns"), event.pop("cycle"), event.pop("kind")
            self._writer.add_event(t_ns, cycle, kind, event)
            if kind == "input" and event["command"]["verb"] == "trajectory":
                self._add_trajectory(t_ns, event["command"])
        self._writer.flush()
        for reader in (self._samples, self._frames, self._events):
            reader.commit()

    def _add_trajectory(self, t_ns: int, command: Mapping[str, Any]) -> None:
        """Keep the reference, unless its slot has been written anew: then its CRC tells."""
        size = command["samples"] * self._shared.config.joints * 3 * 8
        rows = bytes(self._shared.slot(command["slot"])[:size])
        if crc32(rows) == command["crc32"]:
            self._writer.add_trajectory(t_ns, command["crc32"], rows)

    @property
    def is_empty(self) -> bool:
        """Nothing has been recorded."""
        return self._samples.place == 0

    def run(self, parent_pid: int) -> None:
        """Drain until SIGTERM; without supervisor, until the loop has ended.

        Raises:
            RecordingError: If the file cannot be written.
        """
        signals: list[int] = []
        signal.signal(signal.SIGTERM, lambda number, _: signals.append(number))
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        while not signals:
            self._shared.beat("recorder", now_ns())
            self.drain()
            sleep(DRAIN_EVERY_S)
        outlast_loop(self._shared, parent_pid, self.drain)
        self.drain()
        lost = {
            "samples": self._samples.lost,
            "frames": self._frames.lost,
            "events": self._events.lost,
        }
        if any(lost.values()):
            print(f"hil: the recording misses {lost}", file=sys.stderr)  # noqa: T201 - told to the user


def main(shared_fd: int, parent_pid: int, path: str) -> int:
    """Entry of the recorder process.

    Returns:
        0 after an orderly end, 1 with one line on stderr otherwise.
    """
    die_with_parent(parent_pid)
    shared = SharedMemory(shared_fd)
    config = shared.config
    try:
        with RecordingWriter(
            Path(path), config.model_dump_json(), config.joints, with_truth=False
        ) as writer:
            recorder = Recorder(shared, writer)
            recorder.run(parent_pid)
        if recorder.is_empty:  # the loop never came to a cycle: nothing to keep
            Path(path).unlink(missing_ok=True)
    except HilError as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    return 0
