"""What the gateway publishes: every sample, every event, and a status ten times a second.

A sample may be published twice (by a gateway that is killed, and again by its successor), but
none is left out: the place in the ring moves on only when what was read has been sent. `t_ns`
and `seq` tell the second copy from the first.
"""

import json
from collections import deque
from time import monotonic, sleep

import numpy as np
import zenoh

from hil.shared import STATUS_EVERY_S, SharedMemory

STREAM_EVERY_S = 0.01
BATCH_SAMPLES = 1000
EVENTS_AT_ONCE = 100
WINDOW_S = 10.0
"""Lateness and busy time in `status` are over this many seconds."""
RETURN_S = 0.5
"""A successor goes on this long after the first subscriber is back: for the others."""


class Streams:
    """Publishes what the loop writes to shared memory.

    A gateway that succeeds a killed one holds samples and events back until a subscriber has
    reconnected, or until half of the ring is full.
    """

    def __init__(self, shared: SharedMemory, session: zenoh.Session) -> None:
        self._shared = shared
        self._session = session
        self._samples = shared.reader("samples", "gateway")
        self._events = shared.reader("events", "gateway")
        self._notes = shared.reader("notes", "gateway")
        window = round(WINDOW_S / shared.config.loop.period_s)
        self._late_ns: deque[int] = deque(maxlen=window)
        self._busy_ns: deque[int] = deque(maxlen=window)
        reliable = zenoh.CongestionControl.BLOCK
        self._telemetry = self._publisher(
            "telemetry", zenoh.Encoding.APPLICATION_PROTOBUF, reliable
        )
        self._event = self._publisher("event", zenoh.Encoding.APPLICATION_JSON, reliable)
        self._status = self._publisher(
            "status", zenoh.Encoding.APPLICATION_JSON, zenoh.CongestionControl.DROP
        )
        self._is_holding = self._samples.place > 0
        self._subscribed_s: float | None = None
        self._listener = self._telemetry.declare_matching_listener(self._note_matching)

    def _publisher(
        self, name: str, encoding: zenoh.Encoding, congestion: zenoh.CongestionControl
    ) -> zenoh.Publisher:
        return self._session.declare_publisher(
            f"hil/{self._shared.config.arm.name}/{name}",
            encoding=encoding,
            congestion_control=congestion,
        )

    def _note_matching(self, status: zenoh.MatchingStatus) -> None:
        self._subscribed_s = monotonic() if status.matching else None

    def turn(self) -> None:
        """Publish what is new. Blocks while a subscriber does not keep up, for some seconds."""
        self._samples.commit()  # what was put a turn ago has left this process
        self._events.commit()
        self._notes.commit()
        if self._is_holding and self._is_worth_holding():
            return
        self._is_holding = False
        self._publish_samples()
        for events in (self._events, self._notes):
            for record in events.read(EVENTS_AT_ONCE):
                self._event.put(record)

    def run(self, is_ended: list[int]) -> None:
        """Take a turn every 10 ms until `is_ended` is not empty, and one more then."""
        every = round(STATUS_EVERY_S / STREAM_EVERY_S)
        turns = 0
        while not is_ended:
            self.turn()
            if turns % every == 0:
                self.publish_status()
            turns += 1
            sleep(STREAM_EVERY_S)

    def _is_worth_holding(self) -> bool:
        has_room = self._samples.backlog < self._shared.samples.slots // 2
        since_s = self._subscribed_s
        return has_room and (since_s is None or monotonic() - since_s < RETURN_S)

    def _publish_samples(self) -> None:
        layout = self._shared.layout
        while records := self._samples.read(BATCH_SAMPLES):
            self._telemetry.put(layout.batch(records))
            rows = layout.decode(records)
            self._late_ns.extend(rows["wake_late_ns"].tolist())
            self._busy_ns.extend(rows["busy_ns"].tolist())

    def publish_status(self) -> None:
        """Publish the loop's last status with what the gateway knows."""
        status = self._shared.status()
        status["telemetry_published"] = self._samples.place - self._samples.lost
        status["telemetry_lost"] = self._samples.lost
        status["wake_late_us"] = _quantiles_us(self._late_ns)
        status["busy_us"] = _quantiles_us(self._busy_ns)
        status["timing"] = self._shared.timing.summary()
        self._status.put(json.dumps(status))


def _quantiles_us(values_ns: deque[int]) -> dict[str, float]:
    if not values_ns:
        return {}
    p50, p99, p999, most = np.percentile(values_ns, [50, 99, 99.9, 100]) / 1e3
    return {
        "p50": round(p50, 1),
        "p99": round(p99, 1),
        "p99.9": round(p999, 1),
        "max": round(most, 1),
    }
