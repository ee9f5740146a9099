"""What the gateway publishes: every sample, every event, and a status ten times a second.

A sample may be published twice (by a gateway that is killed, and again by its successor), but
none is left out: the place in the ring moves on only when what was read has been sent. `t_ns`
and `seq` tell the second copy from the first.

Nobody waits for a subscriber: every link has a queue of its own, of some seconds of samples, and
what does not fit in it is lost to that subscriber alone, who sees it by `seq`.
"""

import json
from collections import deque
from time import monotonic, sleep
from typing import Any

import numpy as np
import zenoh

from hil.authority import Authority
from hil.shared import STATUS_EVERY_S, SharedMemory

STREAM_EVERY_S = 0.01
BATCH_SAMPLES = 1000
EVENTS_AT_ONCE = 100
WINDOW_S = 10.0
"""Lateness and busy time in `status` are over this many seconds."""
_JSON = zenoh.Encoding.APPLICATION_JSON
_DROP, _BLOCK = zenoh.CongestionControl.DROP, zenoh.CongestionControl.BLOCK
RETURN_S = 0.5
"""A successor goes on this long after the first subscriber is back: for the others."""


class Streams:
    """Publishes what the loop writes to shared memory.

    A gateway that succeeds a killed one holds samples and events back until a subscriber has
    reconnected, or until half of the ring is full.

    Attributes:
        last: The status published last.
    """

    def __init__(self, shared: SharedMemory, session: zenoh.Session, authority: Authority) -> None:
        self._shared = shared
        self._authority = authority
        self.last: dict[str, Any] = shared.status()
        self._session = session
        self._samples = shared.reader("samples", "gateway")
        self._events = shared.reader("events", "gateway")
        self._notes = shared.reader("notes", "gateway")
        window = round(WINDOW_S / shared.config.loop.period_s)
        self._late_ns: deque[int] = deque(maxlen=window)
        self._busy_ns: deque[int] = deque(maxlen=window)
        self._telemetry = self._publisher(
            "telemetry", zenoh.Encoding.APPLICATION_PROTOBUF, congestion_control=_DROP
        )
        self._status = self._publisher("status", _JSON, congestion_control=_DROP)
        own = zenoh.Priority.INTERACTIVE_HIGH  # few: they have a queue of their own in every link
        self._event = self._publisher("event", _JSON, congestion_control=_BLOCK, priority=own)
        self._is_holding = self._samples.place > 0
        self._subscribed_s: float | None = None
        self._listener = self._telemetry.declare_matching_listener(self._note_matching)

    def _publisher(self, name: str, encoding: zenoh.Encoding, **quality: Any) -> zenoh.Publisher:  # noqa: ANN401
        key = f"hil/{self._shared.config.arm.name}/{name}"
        return self._session.declare_publisher(key, encoding=encoding, **quality)

    def _note_matching(self, status: zenoh.MatchingStatus) -> None:
        self._subscribed_s = monotonic() if status.matching else None

    def turn(self) -> None:
        """Publish what is new. Samples for a subscriber whose queue is full are dropped for it."""
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
        status["operator"] = self._authority.holder
        status["telemetry_published"] = self._samples.place - self._samples.lost
        status["telemetry_lost"] = self._samples.lost
        status["wake_late_us"] = _quantiles_us(self._late_ns)
        status["busy_us"] = _quantiles_us(self._busy_ns)
        status["timing"] = self._shared.timing.summary()
        self.last = status
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
