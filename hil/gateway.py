"""The gateway process: Zenoh on one side, shared memory on the other. The loop never waits for it.

Keys under `hil/<arm>/`: streams `telemetry` (Protobuf `hil.v1.SampleBatch`, every cycle), `status`
(JSON, 10 Hz), `event` (JSON); queryables `cmd/<command>`, `schema`, `config`, `status`; liveliness
token `alive`. Operators' tokens are `operator/<name>`.

Threads: the main one says that the gateway is alive, one streams, one answers requests, one those
that end a motion, and one those for authority; none of them waits for another.
"""

import json
import queue
import signal
import sys
import threading
from collections.abc import Callable
from time import sleep
from typing import Final

import zenoh

from hil.desk import LOBBY, Desk
from hil.dispatch import URGENT, Dispatcher
from hil.errors import HilError
from hil.messages import Reply, RequestError, check_size, contract
from hil.process import outlast_loop
from hil.realtime import die_with_parent, now_ns
from hil.session import open_session
from hil.shared import SharedMemory
from hil.streams import Streams

BEAT_EVERY_S = 0.02
WAITING_MOST: Final = 64
WAITING_MOST_BYTES: Final = 16 << 20


class Waiting:
    """Requests that wait for their turn, in bounds."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[tuple[zenoh.Query, bytes]] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._bytes = 0

    def put(self, query: zenoh.Query, payload: bytes) -> bool:
        """Take a request; False if there is no room for it."""
        with self._lock:
            is_full = self._queue.qsize() >= WAITING_MOST
            if is_full or self._bytes + len(payload) > WAITING_MOST_BYTES:
                return False
            self._bytes += len(payload)
        self._queue.put((query, payload))
        return True

    def get(self) -> tuple[zenoh.Query, bytes]:
        """Wait for the next request."""
        query, payload = self._queue.get()
        with self._lock:
            self._bytes -= len(payload)
        return query, payload


class Gateway:
    """Publishes what the loop writes, and passes requests on to it."""

    def __init__(self, shared: SharedMemory, session: zenoh.Session) -> None:
        self._shared = shared
        self._session = session
        self._prefix = f"hil/{shared.config.arm.name}"
        self._dispatcher = Dispatcher(shared)
        self._desk = Desk(shared, self._dispatcher, now_ns)
        self._streams = Streams(shared, session, self._desk.authority)
        self._requests = Waiting()
        self._urgent = Waiting()
        self._lobby = Waiting()
        self._contract = contract()
        self._signals: list[int] = []

    def run(self, parent_pid: int) -> None:
        """Serve until SIGTERM; without supervisor, until the loop has ended."""
        signal.signal(signal.SIGTERM, lambda number, _: self._signals.append(number))
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor decides
        streaming = self._start(self._streams.run, self._signals)
        queues = (self._requests, self._urgent, self._lobby)
        threads = [streaming, *(self._start(self._serve, waiting) for waiting in queues)]
        held = self._declare()
        while not self._signals and all(thread.is_alive() for thread in threads):
            self._shared.beat("gateway", now_ns())
            self._desk.authority.look_after()
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
            session.declare_queryable(f"{prefix}/schema", lambda q: _reply(q, self._contract)),
            session.declare_queryable(f"{prefix}/status", lambda q: _reply(q, self._streams.last)),
            session.declare_queryable(
                f"{prefix}/config", lambda q: _reply(q, self._shared.config.model_dump(mode="json"))
            ),
            session.liveliness().declare_subscriber(
                f"{prefix}/operator/*", self._note_operator, history=True
            ),
            session.liveliness().declare_token(f"{prefix}/alive"),
        ]

    def _note_operator(self, sample: zenoh.Sample) -> None:
        operator = str(sample.key_expr).rpartition("/")[2]
        if sample.kind == zenoh.SampleKind.PUT:
            self._desk.authority.note_present(operator)
        else:
            self._desk.authority.note_gone(operator)

    def _sort(self, query: zenoh.Query) -> None:
        """Queue a request; an emergency stop is passed on at once, before it is answered."""
        verb = str(query.key_expr).rpartition("/")[2]
        try:
            check_size(verb, len(query.payload) if query.payload is not None else 0)
        except RequestError as error:
            _answer(query, Reply(ok=False, reason=str(error)))
            return
        payload = bytes(query.payload) if query.payload is not None else b""
        self._dispatcher.forestall(verb, payload)
        if verb in URGENT:
            waiting = self._urgent
        else:
            waiting = self._lobby if verb in LOBBY else self._requests
        if not waiting.put(query, payload):
            _answer(query, Reply(ok=False, code="busy", reason=f"{verb}: too many requests wait"))

    def _serve(self, requests: Waiting) -> None:
        while True:
            query, payload = requests.get()
            verb = str(query.key_expr).rpartition("/")[2]
            _answer(query, self._desk.answer(verb, payload))


def _answer(query: zenoh.Query, reply: Reply) -> None:
    with query:
        _reply(query, reply.model_dump(exclude_none=True))


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
