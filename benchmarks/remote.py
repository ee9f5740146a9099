"""Telemetry from shared memory to a client's array in another process, against a bare Zenoh put.

Both put the same number of bytes over the same kind of link (TCP on loopback) to the same process;
the gateway reads the ring, makes the batch and keeps its figures besides, the client decodes it to
an array and looks for repeated samples. The gateway's pause of 10 ms between two turns is not in
here: it comes on top, up to that.
"""

import socket
import struct
import subprocess
import sys
from contextlib import contextmanager
from time import monotonic_ns

from benchmarks import rig
from benchmarks.measure import Target, at_most, median, percentile, row, times, title, us
from hil.authority import Authority
from hil.config import ZenohSettings
from hil.session import open_session
from hil.shared import SharedMemory
from hil.streams import Streams

ROUNDS, WARM_UP = 200, 20
BATCHES = {10: 5.0, 800: 8.0}
"""Samples: of a turn every 10 ms, and of a gateway that catches up; most times as long as bare."""
STAMP = struct.Struct("<Q")
CLIENT = """
import struct, sys
from time import monotonic_ns
from hil.client import Client
def ours(rows):
    print(monotonic_ns() - int(rows["t_ns"][-1]), len(rows), flush=True)
def bare(sample):
    data = bytes(sample.payload)
    print(monotonic_ns() - struct.unpack_from("<Q", data)[0], len(data), flush=True)
with Client("bench", [sys.argv[1]]) as client:
    client.on_telemetry(ours)
    client._subscribe("bare", bare)
    print("ready", flush=True)
    sys.stdin.read()
"""


def run(scale: float) -> list[Target]:
    title("remote", "shared memory -> gateway -> Zenoh -> client's array, against a bare put")
    row("one way, samples in a batch", "ours p50", "ours p99", "bare p50", "bare p99", "ours/bare")
    shared = SharedMemory.create(rig.configuration(arm={"name": "bench"}))
    endpoint = f"tcp/127.0.0.1:{_free_port()}"
    with open_session(ZenohSettings(listen=(endpoint,))) as session, _client(endpoint) as client:
        feed = Feed(shared, session, client)
        rounds = round(ROUNDS * scale) + WARM_UP
        return [_compare(feed, samples, rounds) for samples in BATCHES]


class Feed:
    """The gateway's side of the stream, and a bare publisher beside it."""

    def __init__(self, shared, session, client):
        self._shared = shared
        self._client = client
        authority = Authority(
            shared.config.remote, shared.lease, lambda _: None, lambda: False, monotonic_ns
        )
        self._streams = Streams(shared, session, authority)
        self._bare = session.declare_publisher("hil/bench/bare")
        self._write = shared.layout.writer()
        self._seq = 0

    def ours(self, samples):
        """Publish so many samples of the ring; return how long the last was on its way, us."""
        self._fill(samples)
        self._streams.turn()
        return self._arrived(samples)

    def bare(self, samples):
        """Publish as many bytes."""
        size = len(self._shared.layout.batch([bytes(self._shared.layout.size)] * samples))
        payload = bytearray(size)
        STAMP.pack_into(payload, 0, monotonic_ns())
        self._bare.put(bytes(payload))
        return self._arrived(size)

    def _fill(self, samples):
        layout, ring = self._shared.layout, self._shared.samples
        zeros = [[0.0] * self._shared.config.joints] * len(layout.list_names)
        for _ in range(samples):
            values = dict.fromkeys(layout.scalar_names, 0)
            values |= {"seq": self._seq, "t_ns": monotonic_ns()}
            self._write(ring.memory, ring.begin(layout.size), list(values.values()), zeros)
            ring.commit()
            self._seq += 1

    def _arrived(self, expected):
        late_ns, count = self._client.stdout.readline().split()
        if int(count) != expected:
            raise SystemExit(f"the client got {count} instead of {expected}")
        return int(late_ns) * 1e-3


def _compare(feed, samples, rounds):
    ours, bare = [], []
    for _ in range(rounds):
        bare.append(feed.bare(samples))
        ours.append(feed.ours(samples))
    ours, bare = ours[WARM_UP:], bare[WARM_UP:]
    ratio = median([a / b for a, b in zip(ours, bare, strict=True)])
    cells = (median(ours), percentile(ours, 0.99), median(bare), percentile(bare, 0.99))
    row(f"{samples}", *map(us, cells), times(ratio))
    row("", f"{samples / median(ours):.2f}/us", "", f"{samples / median(bare):.2f}/us")
    return at_most(f"remote: {samples} samples against a bare put", ratio, BATCHES[samples], "x")


@contextmanager
def _client(endpoint):
    command = [sys.executable, "-c", CLIENT, endpoint]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            if process.stdout.readline() != "ready\n":
                raise SystemExit("the client did not start")
            yield process
        finally:
            process.stdin.close()


def _free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]
