"""The recorder process: writes what the loop left in shared memory to an MCAP file."""

import json
import signal
import sys
import threading
from pathlib import Path
from time import sleep

from hil.errors import HilError
from hil.realtime import die_with_parent
from hil.recording import RecordingWriter
from hil.shared import SharedMemory

DRAIN_EVERY_S = 0.05
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
            first = self._shared.frame_layout.decode_log(log[: self._shared.frame_layout.size])[0]
            self._writer.add_bus_log(first.t_ns, log)
        for record in self._events.read(AT_ONCE):
            event = json.loads(record)
            t_ns, cycle, kind = event.pop("t_ns"), event.pop("cycle"), event.pop("kind")
            self._writer.add_event(t_ns, cycle, kind, event)

    def run(self) -> None:
        """Drain until SIGTERM, and once more then.

        Raises:
            RecordingError: If the file cannot be written.
        """
        is_ended = threading.Event()
        signal.signal(signal.SIGTERM, lambda *_: is_ended.set())
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        while not is_ended.is_set():
            self.drain()
            sleep(DRAIN_EVERY_S)
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
            Recorder(shared, writer).run()
    except HilError as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    return 0
