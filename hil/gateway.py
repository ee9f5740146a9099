"""The gateway process: Zenoh on one side, shared memory on the other. The loop never waits for it.

Keys under `hil/<arm>/`: streams `telemetry` (Protobuf `hil.v1.SampleBatch`, every cycle), `status`
(JSON, 10 Hz), `event` (JSON); queryables `cmd/<command>`, `schema`, `config`; liveliness token
`alive`.
"""

import json
import queue
import signal
import sys
import threading
from collections import deque
from time import sleep

import numpy as np
import zenoh

from controller.machine import State
from hil.dispatch import Dispatcher, Present
from hil.errors import HilError
from hil.messages import schemas
from hil.realtime import die_with_parent, now_ns
from hil.session import open_session
from hil.shared import STATUS_EVERY_S, SharedMemory

STREAM_EVERY_S = 0.01
BATCH_SAMPLES = 1000
EVENTS_AT_ONCE = 100
WINDOW_S = 10.0
"""Lateness and busy time in `status` are over this many seconds."""


class Gateway:
    """Publishes what the loop writes, and passes requests on to it."""

    def __init__(self, shared: SharedMemory, session: zenoh.Session) -> None:
        self._shared = shared
        self._session = session
        self._prefix = f"hil/{shared.config.arm.name}"
        self._dispatcher = Dispatcher(shared)
        self._requests: queue.SimpleQueue[zenoh.Query] = queue.SimpleQueue()
        self._samples = shared.reader("samples", "gateway")
        self._events = shared.reader("events", "gateway")
        self._is_ended = threading.Event()
        self._published = 0
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

    def _publisher(
        self, name: str, encoding: zenoh.Encoding, congestion: zenoh.CongestionControl
    ) -> zenoh.Publisher:
        return self._session.declare_publisher(
            f"{self._prefix}/{name}", encoding=encoding, congestion_control=congestion
        )

    def run(self) -> None:
        """Serve until SIGTERM."""
        signal.signal(signal.SIGTERM, lambda *_: self._is_ended.set())
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        worker = threading.Thread(target=self._serve_requests, daemon=True)
        worker.start()
        held = self._declare()
        every = round(STATUS_EVERY_S / STREAM_EVERY_S)
        turn = 0
        while not self._is_ended.is_set():
            self._shared.beat("gateway", now_ns())
            self._stream_samples()
            self._stream_events()
            if turn % every == 0:
                self._publish_status()
            turn += 1
            sleep(STREAM_EVERY_S)
        self._stream_samples()
        self._stream_events()
        self._publish_status()
        del held

    def _declare(self) -> list[object]:
        session, prefix = self._session, self._prefix
        return [
            session.declare_queryable(f"{prefix}/cmd/*", self._requests.put),
            session.declare_queryable(f"{prefix}/schema", lambda q: _reply(q, schemas())),
            session.declare_queryable(
                f"{prefix}/config", lambda q: _reply(q, self._shared.config.model_dump(mode="json"))
            ),
            session.liveliness().declare_token(f"{prefix}/alive"),
        ]

    # --- streams -----------------------------------------------------------------------------

    def _stream_samples(self) -> None:
        layout = self._shared.layout
        while records := self._samples.read(BATCH_SAMPLES):
            self._telemetry.put(layout.batch(records))
            self._published += len(records)
            rows = layout.decode(records)
            self._late_ns.extend(rows["wake_late_ns"].tolist())
            self._busy_ns.extend(rows["busy_ns"].tolist())
            last = rows[-1]
            self._dispatcher.present = Present(
                State(int(last["state"])), float(last["t_ref_s"]), last["q_des_rad"].tolist()
            )

    def _stream_events(self) -> None:
        for record in self._events.read(EVENTS_AT_ONCE):
            event = json.loads(record)
            if event["kind"] == "command":
                self._dispatcher.take_outcome(event)
            self._event.put(record)

    def _publish_status(self) -> None:
        status = self._shared.status()
        status["telemetry_published"] = self._published
        status["telemetry_lost"] = self._samples.lost
        status["wake_late_us"] = _quantiles_us(self._late_ns)
        status["busy_us"] = _quantiles_us(self._busy_ns)
        self._status.put(json.dumps(status))

    # --- requests ----------------------------------------------------------------------------

    def _serve_requests(self) -> None:
        while True:
            query = self._requests.get()
            with query:
                verb = str(query.key_expr).rpartition("/")[2]
                payload = bytes(query.payload) if query.payload is not None else b""
                reply = self._dispatcher.answer(verb, payload)
                _reply(query, reply.model_dump(exclude_none=True))


def _reply(query: zenoh.Query, value: object) -> None:
    query.reply(query.key_expr, json.dumps(value), encoding=zenoh.Encoding.APPLICATION_JSON)


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


def main(shared_fd: int, parent_pid: int) -> int:
    """Entry of the gateway process.

    Returns:
        0 after an orderly end, 1 with one line on stderr otherwise.
    """
    die_with_parent(parent_pid)
    shared = SharedMemory(shared_fd)
    try:
        with open_session(shared.config.zenoh) as session:
            Gateway(shared, session).run()
    except HilError as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    return 0
