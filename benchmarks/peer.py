"""The other end of a bus, for benchmarks: emulated amplifiers first, then prepared answers.

At first it runs the emulated amplifiers by the clock, so that a master can start up, and notes
what they answer to each identifier. After `REPLAY` it answers every frame with what was noted,
without looking at its data. So cheap a peer leaves the master's own cost visible, and serves a
master and a bare socket alike.

`python -m benchmarks.peer KIND NAME FAMILY PROCESSOR` is one in a process of its own; it prints
the bus's address when it is ready, and ends when its standard input does.
"""

import os
import pty
import select
import socket
import sys
import tty
from abc import ABC, abstractmethod
from contextlib import suppress
from threading import Event, Thread
from time import monotonic_ns
from typing import Any

import can

from benchmarks import rig
from drivers.buses.python_can import from_message, to_message
from drivers.buses.slcan_codec import decode_frame, encode_frame
from drivers.buses.unix import RECORD_LIMIT
from drivers.frame import EFF_FLAG, pack_frame
from drivers.registry import SETTINGS
from hil.config import Config
from hil.emulation import build_emulator

REPLAY_ID = EFF_FLAG | 0x1FFF_FE01
REPLAY = pack_frame(REPLAY_ID)
"""From now on: prepared answers."""
EXTRA_EVERY = 100
"""What amplifiers send unasked, heartbeats for example, goes before every so-manieth answer."""
TAU_MAX_NM = (15.0, 8.0)
STEP_S = 1e-3
STALL_NS = 2_000_000
"""A host that stood still for longer is not to look like a master that did."""


def configuration(family: str) -> Config:
    """Return two axes of a family, as the defaults have them."""
    tables = {
        str(joint): SETTINGS[family].defaults(joint, tau_Nm)
        for joint, tau_Nm in enumerate(TAU_MAX_NM, start=1)
    }
    return rig.configuration(axes=tables)


class Medium(ABC):
    """One end of a bus whose frames travel as units: records, lines or messages."""

    address: str

    @abstractmethod
    def read(self, timeout_s: float | None) -> list[Any]:
        """Return the units that have come; raises EOFError when nobody is there any more."""

    @abstractmethod
    def write(self, unit: Any) -> None: ...

    @abstractmethod
    def key(self, unit: Any) -> Any:
        """Return what tells identifiers apart."""

    def encode(self, record: bytes) -> Any:
        return record

    def decode(self, unit: Any) -> bytes | None:
        return unit  # type: ignore[no-any-return] # a unit is a record unless a medium differs


class SocketMedium(Medium):
    """Records on a connected or raw socket."""

    def __init__(self, endpoint: socket.socket, address: str) -> None:
        self.address = address
        self._socket = endpoint

    def read(self, timeout_s: float | None) -> list[bytes]:
        if timeout_s is not None and not select.select((self._socket,), (), (), timeout_s)[0]:
            return []
        record = self._socket.recv(RECORD_LIMIT)
        if not record:
            raise EOFError
        return [record]

    def write(self, unit: bytes) -> None:
        self._socket.send(unit)

    def key(self, unit: bytes) -> bytes:
        return unit[:4]


class PtyMedium(Medium):
    """Lines of slcan on a pty; set-up commands stay without an answer, as of some adapters."""

    def __init__(self) -> None:
        self._fd, self._other = pty.openpty()
        tty.setraw(self._other)
        self.address = f"slcan:{os.ttyname(self._other)}"
        self._rest = b""

    def read(self, timeout_s: float | None) -> list[bytes]:
        if timeout_s is not None and not select.select((self._fd,), (), (), timeout_s)[0]:
            return []
        *lines, self._rest = (self._rest + os.read(self._fd, 4096)).split(b"\r")
        return lines

    def write(self, unit: bytes) -> None:
        os.write(self._fd, unit)

    def key(self, unit: bytes) -> bytes:
        return unit[: 9 if unit[:1] in b"TR" else 4]

    def encode(self, record: bytes) -> bytes:
        return encode_frame(record)

    def decode(self, unit: bytes) -> bytes | None:
        return decode_frame(unit)


class MessageMedium(Medium):
    """Messages of a python-can bus within this process."""

    def __init__(self, interface: str, channel: str) -> None:
        self.address = f"python-can:{interface}:{channel}"
        self._bus = can.Bus(interface=interface, channel=channel)
        self.is_over = Event()

    def read(self, timeout_s: float | None) -> list[can.Message]:
        message = self._bus.recv(0.1 if timeout_s is None else timeout_s)
        if self.is_over.is_set():
            self._bus.shutdown()
            raise EOFError
        return [] if message is None else [message]

    def write(self, unit: can.Message) -> None:
        self._bus.send(unit)

    def key(self, unit: can.Message) -> int:
        return unit.arbitration_id

    def encode(self, record: bytes) -> can.Message:
        return to_message(record)

    def decode(self, unit: can.Message) -> bytes | None:
        return from_message(unit)


def serve(medium: Medium, config: Config) -> None:
    """Be the peer until nobody is there any more."""
    with suppress(EOFError, OSError):
        answers, unasked = _emulate(medium, config)
        _answer(medium, answers, unasked)


def _emulate(medium: Medium, config: Config) -> tuple[dict[Any, list[Any]], list[Any]]:
    """Run the amplifiers until `REPLAY`; return the answers by key, and what came unasked."""
    sent: list[bytes] = []
    answers: dict[Any, list[Any]] = {}
    unasked: dict[bytes, Any] = {}

    def transmit(record: bytes) -> None:
        sent.append(record)
        medium.write(medium.encode(record))

    emulator = build_emulator(config, transmit, is_lockstep=False)
    emulator.power_on()
    last_ns = monotonic_ns()
    while True:
        for unit in medium.read(STEP_S):
            sent.clear()
            record = medium.decode(unit)
            if record is None:
                continue
            if record[:4] == REPLAY[:4]:
                asked_for = {medium.key(each) for units in answers.values() for each in units}
                alone = [each for each in unasked.values() if medium.key(each) not in asked_for]
                return answers, alone
            emulator.receive(record)
            answers[medium.key(unit)] = [medium.encode(each) for each in sent]
        now_ns = monotonic_ns()
        if now_ns - last_ns >= STEP_S * 1e9:
            sent.clear()
            emulator.advance(min(now_ns - last_ns, STALL_NS))
            last_ns = now_ns
            unasked |= {each[:4]: medium.encode(each) for each in sent}


def _answer(medium: Medium, answers: dict[Any, list[Any]], unasked: list[Any]) -> None:
    read, write, key = medium.read, medium.write, medium.key
    first = None  # what begins an exchange
    count = 0
    while True:
        for unit in read(None):
            name = key(unit)
            if first is None and answers.get(name):
                first = name
            if name == first:
                count += 1
                if count % EXTRA_EVERY == 0:
                    for each in unasked:
                        write(each)
            for each in answers.get(name, ()):
                write(each)


def listen(path: str) -> socket.socket:
    """Return the listening end of a unix bus for one master."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    listener.bind(path)
    listener.listen(1)
    return listener


def open_can(interface: str) -> SocketMedium:
    """Return a raw socket that also carries CAN FD."""
    endpoint = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
    endpoint.setsockopt(socket.SOL_CAN_RAW, socket.CAN_RAW_FD_FRAMES, 1)
    endpoint.bind((interface,))
    return SocketMedium(endpoint, f"socketcan:{interface}")


def main(kind: str, name: str, family: str, processor: str) -> None:
    """Serve one master on one bus."""
    os.sched_setaffinity(0, {int(processor)})
    config = configuration(family)
    if kind == "unix":
        listener = listen(name)
        print(f"unix:{name}", flush=True)
        serve(SocketMedium(listener.accept()[0], f"unix:{name}"), config)
        return
    medium = PtyMedium() if kind == "slcan" else open_can(name)
    print(medium.address, flush=True)
    serve(medium, config)


def _end_with_input() -> None:
    """End the process when whoever started it has gone."""
    sys.stdin.read()
    os._exit(0)


if __name__ == "__main__":
    Thread(target=_end_with_input, daemon=True).start()
    main(*sys.argv[1:])
