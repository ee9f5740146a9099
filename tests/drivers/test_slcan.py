"""The slcan bus at a real pty: set-up, the two queues, answers, unplugging. The other end is the
emulator's adapter, or bare bytes."""

import os
import select
import threading
import time
import tty
from contextlib import contextmanager

import pytest

from drivers.bus import open_bus
from drivers.buses import slcan
from drivers.buses.slcan import WINDOW_FRAMES, SlcanBus
from drivers.buses.slcan_codec import StatusFlags
from drivers.buses.slcan_port import SlcanAddress
from drivers.errors import BusAddressError, BusError
from drivers.frame import EFF_FLAG, ERR_FLAG, pack_frame, unpack_frame
from sim_backend.slcan_wire import SlcanPty

WAIT_S = 5.0
FRAME = pack_frame(0x181, bytes(range(8)))
LINE = b"t18180001020304050607\r"


class Port:
    """The adapter's end of a pty. While it is served, commands get the answers given."""

    def __init__(self, answers):
        self.fd, host_fd = os.openpty()
        tty.setraw(host_fd)
        os.set_blocking(self.fd, False)
        self.name = os.ttyname(host_fd)
        self.said = b""
        self._host_fd = host_fd  # kept open: the pty does not hang up while nobody else has it
        self._answers = answers

    @contextmanager
    def served(self):
        is_over = threading.Event()
        thread = threading.Thread(target=self._serve, args=(is_over,))
        thread.start()
        try:
            yield
        finally:
            is_over.set()
            thread.join()

    def _serve(self, is_over):
        begun = b""
        while not is_over.is_set():
            if not select.select([self.fd], [], [], 0.01)[0]:
                continue
            *commands, begun = (begun + os.read(self.fd, 4096)).split(b"\r")
            for command in commands:
                self.said += command + b"\r"
                os.write(self.fd, self._answers.get(command, b""))

    def say(self, data):
        """Write, and wait until the host's end has it: the kernel hands it over by a thread."""
        os.write(self.fd, data)
        assert select.select([self._host_fd], [], [], WAIT_S)[0]

    def hear(self, size=0):
        """So many bytes that have been written to this end, and what else is there by now."""
        heard = b""
        while len(heard) < size:
            assert select.select([self.fd], [], [], WAIT_S)[0], heard
            heard += os.read(self.fd, 65536)
        while select.select([self.fd], [], [], 0.02)[0]:
            heard += os.read(self.fd, 65536)
        return heard

    def close(self):
        for fd in (self.fd, self._host_fd):
            os.close(fd)


ANSWERS = {b"C": b"\r", b"S8": b"\r", b"O": b"\r", b"L": b"\r", b"Z1": b"\r", b"S6": b"\r"}


@pytest.fixture
def make_port():
    ports = []

    def make(answers=ANSWERS):
        ports.append(Port(answers))
        return ports[-1]

    yield make
    for port in ports:
        port.close()


@pytest.fixture
def port(make_port):
    return make_port()


@pytest.fixture
def join():
    """Open buses at ports that answer, close them in the end."""
    buses = []

    def join(port, options=""):
        with port.served():
            buses.append(open_bus(f"slcan:{port.name}{options}"))
        return buses[-1]

    yield join
    for bus in buses:
        bus.close()


# --- addresses


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("/dev/ttyACM0", SlcanAddress("/dev/ttyACM0")),
        ("/dev/ttyACM0@500000", SlcanAddress("/dev/ttyACM0", 500_000)),
        (
            "/dev/ttyUSB0@800000,baud=3000000,ack,timestamps",
            SlcanAddress("/dev/ttyUSB0", 800_000, 3_000_000, True, False, True),
        ),
        ("/dev/a,b:c@d,listen", SlcanAddress("/dev/a,b:c@d", is_listening=True)),
        ("pty=/tmp/x@1000000", SlcanAddress("/tmp/x")),
    ],
)
def test_address__each_form__is_understood(text, expected):
    assert SlcanAddress.parse(text) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"is not slcan:DEVICE\[@BITRATE\]"),
        (",ack", r"is not slcan:DEVICE"),
        ("pty=", r"is not slcan:DEVICE"),
        ("pty", r"is the emulator's; use the name that `hil emulate` printed"),
        ("/dev/x@750000", r"CAN bit rate 750000 is not one of 10000, .*1000000"),
        ("/dev/x,baud=12345", r"serial speed 12345 is not one of 9600, .*115200"),
    ],
)
def test_address__unusable__says_what_is(text, message):
    with pytest.raises(BusAddressError, match=message):
        SlcanAddress.parse(text)


# --- opening


@pytest.mark.parametrize(
    ("options", "commands"),
    [
        ("", b"\r\r\rC\rS8\rO\r"),
        ("@500000", b"\r\r\rC\rS6\rO\r"),
        (",ack,listen", b"\r\r\rC\rS8\rL\r"),
        (",timestamps", b"\r\r\rC\rZ1\rS8\rO\r"),
    ],
)
def test_open__each_option__sends_its_commands(port, join, options, commands):
    bus = join(port, options)
    assert port.said == commands
    assert bus.stats.acknowledged == bus.stats.malformed_records == 0


def test_open__adapter_never_answers__works(make_port, join):
    port = make_port({})
    bus = join(port)
    assert bus.send(FRAME)
    port.say(LINE)
    assert bus.recv(WAIT_S) == FRAME


def test_open__adapter_never_answers_but_should__is_refused(make_port, join):
    with pytest.raises(BusError, match=r"does not answer S8 within 0\.1 s; .*Leave `ack` out"):
        join(make_port({}), ",ack")


@pytest.mark.parametrize(
    ("command", "what"), [(b"S8", "1000000 bit/s"), (b"O", "open its channel")]
)
def test_open__adapter_refuses__says_which_command(make_port, join, command, what):
    with pytest.raises(BusError, match=rf"refuses .*{what} \(command {command.decode()}\)"):
        join(make_port(ANSWERS | {command: b"\a"}))


def test_open__first_frame_instead_of_an_answer__is_kept(make_port, join):
    bus = join(make_port({b"O": LINE}))
    assert bus.recv(0.0) == FRAME


def test_open__channel_left_open_by_an_earlier_program__old_frames_are_gone(make_port, join):
    port = make_port(ANSWERS | {b"": LINE * 5, b"C": LINE + b"\r"})
    os.write(port.fd, LINE * 100 + b"t18")
    bus = join(port)
    assert bus.recv(0.02) is None
    assert bus.stats.malformed_records == 0
    port.say(LINE)
    assert bus.recv(WAIT_S) == FRAME


def test_open__no_such_file__says_what_to_do(tmp_path):
    with pytest.raises(BusError, match=r"no such file; plug the adapter in, or start `hil emul"):
        SlcanBus(f"{tmp_path}/nosuch")


def test_open__ordinary_file__is_no_serial_port(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path, tmp_path / "file"):
        with pytest.raises(BusError, match="this is no serial port"):
            SlcanBus(str(path))


def test_open__second_program_at_one_port__is_refused(port, join):
    bus = join(port)
    with pytest.raises(BusError, match="in use by another program; stop it first"):
        SlcanBus(port.name)
    port.say(LINE)
    assert bus.recv(WAIT_S) == FRAME


def test_close__leaves_the_channel_closed(port, join):
    bus = join(port)
    bus.send(FRAME)
    bus.close()
    assert port.hear(len(LINE) + 2) == LINE + b"C\r"


# --- receiving


def test_recv__line_in_pieces__is_one_frame(port, join):
    bus = join(port)
    for character in LINE[:-1]:
        port.say(bytes([character]))
        assert bus.recv(0.0) is None
    port.say(LINE[-1:])
    assert bus.recv(WAIT_S) == FRAME


def test_recv__many_lines_in_one_read__come_one_by_one(port, join):
    bus = join(port)
    port.say(b"t0010\rt0020\rT000000030\rt00")
    port.say(b"40\r")
    received = [bus.recv(WAIT_S) for _ in range(4)]
    assert received == [pack_frame(1), pack_frame(2), pack_frame(3 | EFF_FLAG), pack_frame(4)]
    assert bus.recv(0.0) is None


GARBAGE = [b"hello\r", b"t18\r", b"t1811\r", b"\xff\x00\n\r", b"x" * 500 + b"\r", b"t1810t1810\r"]


@pytest.mark.parametrize("garbage", GARBAGE)
def test_recv__garbage__is_counted_and_the_next_frame_read(port, join, garbage):
    bus = join(port)
    port.say(garbage + LINE)
    assert bus.recv(WAIT_S) == FRAME
    assert bus.stats.malformed_records == 1
    assert bus.stats.frames_received == 1


def test_recv__only_garbage__time_out_still_holds(port, join):
    bus = join(port)
    port.say(b"garbage\r")
    began_s = time.monotonic()
    assert bus.recv(0.02) is None
    assert 0.02 <= time.monotonic() - began_s < 1.0


def test_recv__short_time_out__has_microseconds(port, join):
    bus = join(port)
    began_s = time.monotonic()
    for _ in range(100):
        bus.recv(100e-6)
    took_s = time.monotonic() - began_s
    assert took_s >= 0.01
    assert min(_timed(bus) for _ in range(50)) < 0.9e-3


def _timed(bus):
    began_s = time.monotonic()
    bus.recv(100e-6)
    return time.monotonic() - began_s


def test_recv__error_reports_of_the_adapter__carry_the_flag(port, join):
    bus = join(port)
    port.say(b"sb000000\re1a\r")
    assert bus.recv(WAIT_S) == pack_frame(ERR_FLAG | 0x40, bytes(8))
    assert unpack_frame(bus.recv(WAIT_S))[0] & ERR_FLAG
    assert (bus.stats.error_frames, bus.stats.frames_received) == (2, 0)


def test_recv__time_stamps_asked_for__belong_to_their_frames(port, join):
    bus = join(port, ",timestamps")
    port.say(b"t0010000A\rt0020\rt003112EA5F\rt00421234\rsb000000\r")
    assert [(bus.recv(WAIT_S), bus.timestamp_ms) for _ in range(5)] == [
        (pack_frame(1), 10),
        (pack_frame(2), None),
        (pack_frame(3, b"\x12"), 59_999),
        (pack_frame(4, b"\x12\x34"), None),
        (pack_frame(ERR_FLAG | 0x40, bytes(8)), None),
    ]


def test_recv__time_stamps_not_asked_for__are_ignored(port, join):
    bus = join(port)
    port.say(b"t0010000A\r")
    assert bus.recv(WAIT_S) == pack_frame(1)
    assert (bus.timestamp_ms, bus.stats.malformed_records) == (None, 0)


# --- sending


def test_send__port_full__whole_frames_are_lost_and_partial_ones_completed(port, join):
    bus = join(port)
    sent = 0
    while bus.send(FRAME):
        sent += 1
        assert sent < 100_000
    assert bus.send(FRAME) is False
    assert (bus.stats.frames_sent, bus.stats.send_failures) == (sent, 2)
    rest = len(bus._pending)
    assert 0 < rest < len(LINE)
    heard = port.hear(sent * len(LINE) - rest)
    assert bus.recv(0.0) is None  # completes the last line
    assert heard + port.hear(rest) == LINE * sent
    assert bus.send(FRAME) is True
    assert port.hear(len(LINE)) == LINE


def test_send__line_cut_short__next_frame_follows_it_whole(port, join):
    bus = join(port)
    while bus.send(FRAME):
        pass
    assert bus._pending
    sent, rest = bus.stats.frames_sent, len(bus._pending)
    heard = port.hear(sent * len(LINE) - rest)
    assert bus.send(pack_frame(0x7FF)) is True
    assert heard + port.hear(rest + 6) == LINE * sent + b"t7FF0\r"


def test_send__no_classic_frame__is_lost_and_counted(port, join):
    bus = join(port)
    for record in (pack_frame(ERR_FLAG | 0x40, bytes(8)), bytes(72), b""):
        assert bus.send(record) is False
    assert (bus.stats.frames_sent, bus.stats.send_failures) == (0, 3)
    assert port.hear() == b""


def test_send__opened_to_listen__says_so(port, join):
    with pytest.raises(BusError, match="opened to listen, not to send"):
        join(port, ",listen").send(FRAME)
    assert port.hear() == b""


def test_refusal__of_a_frame__is_counted_as_its_loss(port, join):
    bus = join(port)
    bus.send(FRAME)
    port.say(b"\a")
    assert bus.recv(0.0) is None
    stats = bus.stats
    assert (stats.refused, stats.send_failures, stats.malformed_records) == (1, 1, 0)


def test_acknowledgements__off__are_swallowed(port, join):
    bus = join(port)
    port.say(b"z\rZ\r\r" + LINE)
    assert bus.recv(WAIT_S) == FRAME
    assert (bus.stats.acknowledged, bus.stats.malformed_records) == (3, 0)


def test_acknowledgements__on_and_missing__frames_wait_in_a_window(port, join, monkeypatch):
    bus = join(port, ",ack")
    monkeypatch.setattr(slcan, "ANSWER_TIMEOUT_S", 1e9)
    sent = 0
    while bus.send(FRAME):
        sent += 1
    assert sent == WINDOW_FRAMES
    port.say(b"z\r" * 3 + b"\a")
    assert [bus.send(FRAME) for _ in range(5)] == [True] * 4 + [False]
    monkeypatch.setattr(slcan, "ANSWER_TIMEOUT_S", 0.0)
    assert bus.send(FRAME)  # the adapter has had its time: the others are given up
    stats = bus.stats
    assert (stats.acknowledged, stats.refused, stats.unanswered) == (3, 1, WINDOW_FRAMES)


# --- asking


def test_ask__answers_among_frames__neither_is_lost(make_port, join):
    answers = {b"F": LINE + b"F84\r", b"V": b"V1013\r" + LINE, b"N": b"zNA12\rNA123\r"}
    port = make_port(ANSWERS | answers)
    bus = join(port)
    with port.served():
        assert bus.read_status() == StatusFlags.BUS_ERROR | StatusFlags.ERROR_WARNING
        assert bus.read_version() == "1013"
        assert bus.read_serial() == "A123"
    assert [bus.recv(0.0), bus.recv(0.0), bus.recv(0.0)] == [FRAME, FRAME, None]


def test_ask__no_answer__is_none(make_port, join):
    port = make_port(ANSWERS | {b"V": b"\a", b"F": b"FGG\r"})
    bus = join(port)
    with port.served():
        assert (bus.read_status(), bus.read_version(), bus.read_serial()) == (None, None, None)


# --- unplugging


class Served:
    """The emulator's adapter at a link, echoing every frame, until it is unplugged."""

    def __init__(self, link):
        self.wire = SlcanPty(f"pty={link}")
        self._is_over = threading.Event()
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def _serve(self):
        while not self._is_over.is_set():
            for frame in self.wire.wait(0.01):
                self.wire.transmit(frame)

    def unplug(self):
        self._is_over.set()
        self._thread.join()
        self.wire.close()


def test_bus__unplugged_and_plugged_in_again__can_be_opened_again(tmp_path):
    address = f"slcan:{tmp_path}/adapter"
    for _ in range(3):
        adapter = Served(tmp_path / "adapter")
        bus = open_bus(address)
        assert bus.send(FRAME)
        assert bus.recv(WAIT_S) == FRAME
        adapter.unplug()
        assert_gone(bus.recv, 0.0)
        assert_gone(bus.recv, 0.01)
        assert_gone(bus.send, FRAME)
        bus.close()
        with pytest.raises(BusError, match="no such file"):
            open_bus(address)


def assert_gone(use, argument):
    with pytest.raises(BusError, match=r"is gone: adapter unplugged.*plug it in") as caught:
        use(argument)
    assert "\n" not in str(caught.value)


def test_recv__unplugged_while_waiting__raises_at_once(tmp_path):
    adapter = Served(tmp_path / "adapter")
    with open_bus(f"slcan:{tmp_path}/adapter") as bus:
        thread = threading.Thread(target=adapter.unplug)
        thread.start()
        began_s = time.monotonic()
        with pytest.raises(BusError, match="gone"):
            bus.recv(60.0)
        assert time.monotonic() - began_s < 30.0
        thread.join()
