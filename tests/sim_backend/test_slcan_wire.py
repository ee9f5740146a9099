"""The emulated adapter at its pty: hosts that come, go, babble and do not read."""

import os
import random
import select
import stat
import sys
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from drivers.bus import open_bus
from drivers.buses.slcan import SlcanBus
from drivers.buses.slcan_codec import StatusFlags, encode_frame
from drivers.frame import EFF_FLAG, ERR_FLAG, FRAME_SIZE, pack_fd_frame, pack_frame, unpack_frame
from sim_backend.errors import SimError
from sim_backend.hub import BusWire, open_wire
from sim_backend.slcan_wire import SlcanPty

WAIT_S = 5.0
FRAME, LINE = pack_frame(0x181, b"\x01\x02"), b"t18120102\r"
FUZZ_BYTES = int(os.environ.get("HIL_TEST_SLCAN_FUZZ_BYTES", "1000000"))
"""Bytes into each side."""


@pytest.fixture
def wire():
    with SlcanPty() as wire:
        yield wire


class Host:
    """A program at the pty that writes and reads bare bytes."""

    def __init__(self, wire):
        self.wire = wire
        self.fd = os.open(wire.name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)

    def write(self, data):
        assert os.write(self.fd, data) == len(data)

    def read(self, size):
        data = b""
        while len(data) < size:
            assert select.select([self.fd], [], [], WAIT_S)[0], data
            data += os.read(self.fd, 65536)
        return data

    def command(self, data, answer):
        """Write, have the adapter work until it has answered, and compare."""
        self.write(data)
        frames = []
        seen = b""
        deadline_s = time.monotonic() + WAIT_S
        while len(seen) < len(answer):
            assert time.monotonic() < deadline_s, seen
            frames += self.wire.wait(0.001)
            if select.select([self.fd], [], [], 0.0)[0]:
                seen += os.read(self.fd, 65536)
        assert seen == answer
        return frames

    def close(self):
        os.close(self.fd)


@pytest.fixture
def host(wire):
    host = Host(wire)
    yield host
    host.close()


@contextmanager
def served(wire, frames=None):
    """Have a thread serve the wire, as the emulator would; its frames go to a list."""
    is_over = threading.Event()

    def serve():
        while not is_over.is_set():
            got = wire.wait(0.01)
            if frames is not None:
                frames.extend(got)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


def join(wire, options=""):
    with served(wire):
        return open_bus(f"{wire.address}{options}")


def collect(wire, number):
    frames = []
    deadline_s = time.monotonic() + WAIT_S
    while len(frames) < number:
        assert time.monotonic() < deadline_s
        frames += wire.wait(0.05)
    return frames


def wait_for_hang_up(wire):
    deadline_s = time.monotonic() + WAIT_S
    while wire.adapter.is_open:
        wire.wait(0.001)
        assert time.monotonic() < deadline_s


# --- the conversation


def test_wire__each_step_of_a_session__is_answered(wire, host):
    host.command(b"V\rN\rt1230\rS8\rO\r", b"V1013\rNHIL1\r\a\r\r")
    assert host.command(LINE + b"F\r", b"F00\r") == [FRAME]
    wire.transmit(pack_frame(0x201 | EFF_FLAG, b"\xff"))
    assert host.read(13) == b"T000002011FF\r"
    assert host.command(b"C\r" + LINE, b"\r\a") == []
    wire.transmit(FRAME)
    host.command(b"V\r", b"V1013\r")  # and no frame before it
    assert (wire.stats.frames_received, wire.stats.malformed_records) == (1, 2)


def test_wire__command_in_pieces__is_carried_out_when_whole(wire, host):
    host.command(b"S8\rO\r", b"\r\r")
    for byte in LINE[:-1]:
        host.write(bytes([byte]))
        assert wire.wait(0.002) == []
    host.write(LINE[-1:])
    assert wire.wait(WAIT_S) == [FRAME]


def test_wire__acknowledgements_asked_for__each_frame_gets_one():
    with SlcanPty("pty,ack") as wire:
        host = Host(wire)
        frames = host.command(b"S8\rO\r" + LINE * 2 + b"T000001810\r", b"\r\rz\rz\rZ\r")
        assert frames == [FRAME, FRAME, pack_frame(0x181 | EFF_FLAG)]
        host.close()


def test_wire__time_stamps_asked_for__come_with_frames_not_with_reports():
    with SlcanPty(now_ns=lambda: 61_234_000_000) as wire:
        host = Host(wire)
        host.command(b"Z1\rS8\rO\r", b"\r\r\r")
        wire.transmit(FRAME)
        wire.transmit(pack_frame(ERR_FLAG | 0x40, bytes(8)))
        assert host.read(23) == b"t1812010204D2\rsb000000\r"
        host.command(b"F\r", b"F20\r")
        host.close()


def test_wire__error_reports__reach_the_bus_and_its_flags(wire):
    with join(wire) as bus:
        wire.transmit(pack_frame(ERR_FLAG | 0x88, bytes((0, 0, 0x04, 0, 0, 0, 0, 0))))
        received = bus.recv(WAIT_S)
        assert unpack_frame(received)[0] & ERR_FLAG
        assert bus.stats.error_frames == 1
        with served(wire):
            assert bus.read_status() == StatusFlags.BUS_ERROR
            assert (bus.read_version(), bus.read_serial()) == ("1013", "HIL1")


def test_wire__can_fd_frame__is_lost_and_counted(wire):
    with join(wire) as bus:
        wire.transmit(pack_fd_frame(0x123, bytes(12)))
        wire.transmit(FRAME)
        assert bus.recv(WAIT_S) == FRAME
        assert wire.stats.frames_lost == 1


def test_wire__acknowledged_bus__sends_more_than_its_window():
    with SlcanPty("pty,ack") as wire:
        frames = []
        with join(wire, ",ack") as bus, served(wire, frames):
            sent = 0
            while sent < 1000:
                sent += bus.send(FRAME)
            while bus.stats.acknowledged < sent:
                bus.recv(0.001)
        assert frames == [FRAME] * sent
        assert bus.stats.unanswered == bus.stats.refused == 0


# --- hosts that misbehave


def test_wire__host_does_not_read__loses_whole_frames_and_holds_up_nobody(wire):
    with join(wire) as bus:
        sent = 0
        while not wire.stats.frames_lost:
            wire.transmit(pack_frame(0x7FF, sent.to_bytes(8, "little")))
            sent += 1
            assert sent < 100_000
        with served(wire):
            received = [bus.recv(WAIT_S) for _ in range(sent - 1)]
            assert bus.recv(0.05) is None
            assert bus.read_status() == StatusFlags.RECEIVE_FULL | StatusFlags.DATA_OVERRUN
        assert [int.from_bytes(unpack_frame(f)[1], "little") for f in received] == [
            *range(sent - 1)
        ]
        assert bus.stats.malformed_records == 0


def test_wire__host_asks_and_never_reads__memory_stays_bounded(wire, host):
    host.command(b"S8\rO\r", b"\r\r")
    for _ in range(3000):
        host.write(b"V\r" * 20)
        wire.wait(0.0)
    assert len(wire._queue) < 200_000


def test_wire__host_leaves__channel_closes_and_the_next_one_begins_anew(wire):
    for _ in range(3):
        host = Host(wire)
        host.command(b"S8\rO\r", b"\r\r")
        host.write(LINE + b"t18")
        host.close()
        assert collect(wire, 1) == [FRAME]
        wait_for_hang_up(wire)
        assert wire._queue == b""


def test_wait__nobody_at_the_pty__keeps_the_time_out(wire):
    for timeout_s in (0.0, -1.0, 0.02):
        began_s = time.monotonic()
        assert wire.wait(timeout_s) == []
        assert timeout_s <= time.monotonic() - began_s < 1.0


def test_wait__nobody_at_the_pty__costs_little_time_of_the_processor(wire):
    began_s, cpu_s = time.monotonic(), time.process_time()
    wire.wait(0.2)
    assert time.process_time() - cpu_s < 0.5 * (time.monotonic() - began_s)


def test_wire__closed__says_so(wire):
    wire.close()
    wire.close()
    with pytest.raises(SimError, match=r"the bus at slcan:/dev/pts/.* is closed"):
        wire.wait(0.0)
    with pytest.raises(SimError, match="is closed"):
        wire.transmit(FRAME)


def test_wire__pty__is_for_owner_and_group(wire):
    assert stat.S_IMODE(Path(wire.name).stat().st_mode) == 0o660


# --- the link


def test_link__kept_while_the_wire_exists(tmp_path):
    link = tmp_path / "adapter"
    with SlcanPty(f"pty={link}") as wire:
        assert wire.address == f"slcan:{link}"
        assert str(link.readlink()) == wire.name
    assert not os.path.lexists(link)


def test_link__of_an_emulator_that_was_killed__is_replaced(tmp_path):
    link = tmp_path / "adapter"
    link.symlink_to("/dev/pts/99999")
    with SlcanPty(f"pty={link}") as wire:
        assert str(link.readlink()) == wire.name


def test_link__another_emulator_has_it__is_refused_and_the_other_unharmed(tmp_path):
    link = tmp_path / "adapter"
    with SlcanPty(f"pty={link}") as wire:
        with pytest.raises(SimError, match=f"another emulator already offers a pty at {link}"):
            SlcanPty(f"pty={link}")
        assert str(link.readlink()) == wire.name


@pytest.mark.parametrize("kind", ["file", "link elsewhere"])
def test_link__something_else_in_the_way__is_left_alone(tmp_path, kind):
    link = tmp_path / "adapter"
    if kind == "file":
        link.touch()
    else:
        link.symlink_to("/dev/ttyACM0")
    before = link.lstat()
    with pytest.raises(SimError, match="a file that is no link to a pty is in the way"):
        SlcanPty(f"pty={link}")
    assert link.lstat() == before


def test_link__no_directory__says_so(tmp_path):
    with pytest.raises(SimError, match=f"no directory {tmp_path}/no for slcan:pty="):
        SlcanPty(f"pty={tmp_path}/no/adapter")


# --- addresses


def test_open_wire__each_form__gives_its_wire(tmp_path):
    with open_wire("slcan:pty") as wire:
        assert isinstance(wire, SlcanPty)
        assert wire.address == f"slcan:{wire.name}"
        with served(wire), open_wire(wire.address) as joined:
            assert isinstance(joined, BusWire), "an emulator may sit at a real adapter, too"
    with open_wire(f"slcan:pty={tmp_path}/adapter@500000,ack") as wire:
        assert wire.address == f"slcan:{tmp_path}/adapter"


@pytest.mark.parametrize("address", ["slcan:pty,foo", "slcan:pty=", "slcan:pty=/tmp/x@7"])
def test_open_wire__unusable_address__is_one_line(address):
    with pytest.raises(SimError) as caught:
        open_wire(address)
    assert "\n" not in str(caught.value)
    assert address in str(caught.value)


# --- garbage


def babble(rng, size):
    """Bytes that get far into a parser: commands, frames, damaged ones, pieces, and pure noise."""
    makers = [_noise, _characters, _command, _cut_line, _frame_line, _frame_line, _damaged_line]
    pieces = []
    while size > 0:
        pieces.append(rng.choice(makers)(rng))
        size -= len(pieces[-1])
    return b"".join(pieces)


def _noise(rng):
    return rng.randbytes(rng.randrange(1, 60))


def _characters(rng):
    return bytes(rng.choices(b"tTrRFVNCOLSsZz0123456789ABCDEF\r\a", k=rng.randrange(1, 80)))


def _command(rng):
    return rng.choice([b"\rS8\r", b"\rO\r", b"\rO\r", b"\rO\r", b"\rC\r", b"sb001002\r", b"e1a\r"])


def _cut_line(rng):
    line = rng.choice([b"t", b"T", b"r", b"s", b"e", b"F"]) + rng.randbytes(12).hex().encode()
    return line[: rng.randrange(1, 26)] + rng.choice([b"\r", b"\r", b"", b"\a"])


def _frame_line(rng):
    can_id = rng.choice([rng.getrandbits(11), rng.getrandbits(29) | EFF_FLAG])
    return encode_frame(pack_frame(can_id, rng.randbytes(rng.randrange(9))))


def _damaged_line(rng):
    line = bytearray(_frame_line(rng))
    line[rng.randrange(len(line))] = rng.randrange(256)
    return bytes(line)


def chunks(rng, data):
    start = 0
    while start < len(data):
        size = rng.randrange(1, 600)
        yield data[start : start + size]
        start += size


@pytest.fixture
def say(capsys):
    """Print past pytest's capture: what was tried is to be seen when it passes, too."""

    def say(text):
        with capsys.disabled():
            sys.stdout.write(f"\n{text}")

    return say


@pytest.fixture
def rng(say):
    seed = int(os.environ.get("HIL_TEST_SEED", str(time.time_ns())))
    say(f"slcan: HIL_TEST_SEED={seed} HIL_TEST_SLCAN_FUZZ_BYTES={FUZZ_BYTES}")
    return random.Random(seed)


def test_fuzz__bytes_into_the_bus__no_exception_and_it_goes_on(rng, say):
    wire = SlcanPty()
    with wire, join(wire) as bus:
        sent = 0
        for chunk in chunks(rng, babble(rng, FUZZ_BYTES)):
            rest = chunk
            while rest:
                with suppress(BlockingIOError):
                    rest = rest[os.write(wire._fd, rest) :]
                while (frame := bus.recv(0.0)) is not None:
                    assert len(frame) == FRAME_SIZE
            sent += len(chunk)
        os.write(wire._fd, b"\r" + LINE)
        while (frame := bus.recv(WAIT_S)) != FRAME:
            assert frame is not None
        stats = bus.stats
        say(f"{sent} bytes into the bus: {stats}")
        assert stats.malformed_records > sent // 1000
        assert stats.frames_received > sent // 1000
        assert stats.error_frames > sent // 10_000
        assert bus.send(FRAME)
        assert wire.wait(WAIT_S) == [FRAME]


def test_fuzz__bytes_into_the_adapter__no_exception_and_it_goes_on(rng, say, wire, host):
    sent = 0
    for chunk in chunks(rng, babble(rng, FUZZ_BYTES)):
        rest = chunk
        while rest:
            with suppress(BlockingIOError):
                rest = rest[os.write(host.fd, rest) :]
            for frame in wire.wait(0.0):
                assert len(frame) == FRAME_SIZE
                wire.transmit(frame)
            if rng.random() < 0.5:
                with suppress(BlockingIOError):
                    os.read(host.fd, 65536)
        sent += len(chunk)
    host.write(b"\r")
    while wire.wait(0.01):
        pass
    say(f"{sent} bytes into the adapter: {wire.stats}, {wire.adapter.refusals} refusals")
    assert wire.adapter.refusals > sent // 1000
    assert wire.stats.frames_received > sent // 1000
    with served(wire):
        bus = SlcanBus(wire.name)
    with bus:
        assert bus.send(FRAME)
        assert wire.wait(WAIT_S) == [FRAME]
        wire.transmit(FRAME)
        assert bus.recv(WAIT_S) == FRAME
