"""The gateway process: Zenoh on one side, shared memory on the other. The loop never waits for it.

Keys under `hil/<arm>/`: streams `telemetry` (Protobuf `hil.v1.SampleBatch`, every cycle), `status`
(JSON, 10 Hz), `event` (JSON); queryables `cmd/<command>`, `schema`, `config`; liveliness token
`alive`.

Threads: the main one says that the gateway is alive, one streams (a subscriber that does not keep
up can block it), one answers requests, and one those that end a motion, which wait for no other.
"""

import json
import queue
import signal
import sys
import threading
from collections.abc import Callable
from time import sleep

import zenoh

from hil.dispatch import URGENT, Dispatcher
from hil.errors import HilError
from hil.messages import schemas
from hil.process import outlast_loop
from hil.realtime import die_with_parent, now_ns
from hil.session import open_session
from hil.shared import SharedMemory
from hil.streams import Streams

BEAT_EVERY_S = 0.02

_Queue = queue.SimpleQueue[zenoh.Query]


class Gateway:
    """Publishes what the loop writes, and passes requests on to it."""

    def __init__(self, shared: SharedMemory, session: zenoh.Session) -> None:
        self._shared = shared
        self._session = session
        self._prefix = f"hil/{shared.config.arm.name}"
        self._dispatcher = Dispatcher(shared)
        self._streams = Streams(shared, session)
        self._requests: _Queue = queue.SimpleQueue()
        self._urgent: _Queue = queue.SimpleQueue()
        self._signals: list[int] = []

    def run(self, parent_pid: int) -> None:
        """Serve until SIGTERM; without supervisor, until the loop has ended."""
        signal.signal(signal.SIGTERM, lambda number, _: self._signals.append(number))
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        streaming = self._start(self._streams.run, self._signals)
        threads = [streaming, self._start(self._serve, self._requests)]
        threads.append(self._start(self._serve, self._urgent))
        held = self._declare()
        while not self._signals and all(thread.is_alive() for thread in threads):
            self._shared.beat("gateway", now_ns())
            sleep(BEAT_EVERY_S)
        streaming.join()
        outlast_loop(self._shared, parent_pid, self._streams.turn)
        self._streams.turn()
        self._streams.publish_status()
        del held

    @staticmethod
    def _start(work: Callable[..., None], argument: object) -> threading.Thread:
        thread = threading.Thread(target=work, args=(argument,), daemon=True)
        thread.start()
        return thread

    def _declare(self) -> list[object]:
        session, prefix = self._session, self._prefix
        return [
            session.declare_queryable(f"{prefix}/cmd/*", self._sort),
            session.declare_queryable(f"{prefix}/schema", lambda q: _reply(q, schemas())),
            session.declare_queryable(
                f"{prefix}/config", lambda q: _reply(q, self._shared.config.model_dump(mode="json"))
            ),
            session.liveliness().declare_token(f"{prefix}/alive"),
        ]

    def _sort(self, query: zenoh.Query) -> None:
        """Queue a request; an emergency stop is passed on at once, before it is answered."""
        verb = _verb(query)
        self._dispatcher.forestall(verb, _payload(query))
        (self._urgent if verb in URGENT else self._requests).put(query)

    def _serve(self, requests: _Queue) -> None:
        while True:
            query = requests.get()
            with query:
                reply = self._dispatcher.answer(_verb(query), _payload(query))
                _reply(query, reply.model_dump(exclude_none=True))


def _verb(query: zenoh.Query) -> str:
    return str(query.key_expr).rpartition("/")[2]


def _payload(query: zenoh.Query) -> bytes:
    return bytes(query.payload) if query.payload is not None else b""


def _reply(query: zenoh.Query, value: object) -> None:
    try:
        query.reply(query.key_expr, json.dumps(value), encoding=zenoh.Encoding.APPLICATION_JSON)
    except zenoh.ZError as error:  # the client has gone; the others are still there
        print(f"hil: no reply to {query.key_expr}: {error}", file=sys.stderr)  # noqa: T201


def main(shared_fd: int, parent_pid: int) -> int:
    """Entry of the gateway process.

    Returns:
        0 after an orderly end, 1 with one line on stderr otherwise.
    """
    die_with_parent(parent_pid)
    shared = SharedMemory(shared_fd)
    try:
        with open_session(shared.config.zenoh) as session:
            Gateway(shared, session).run(parent_pid)
    except (HilError, zenoh.ZError) as error:
        print(f"hil: {error}", file=sys.stderr)  # noqa: T201 - the line the user is promised
        return 1
    return 0
