"""Bus tools: monitor, log, play, DBC and EDS, on real buses and as the command line has them."""

import io
import signal
import tempfile
from itertools import pairwise
from time import monotonic

import can
import canopen
import cantools
import pytest

from drivers.bus import open_bus
from drivers.buses.loopback import LoopbackBus
from drivers.cia402.settings import Cia402Settings
from drivers.decoder import FrameDecoder
from drivers.errors import BusAddressError
from drivers.frame import ERR_FLAG, pack_frame, unpack_frame
from drivers.frame_log import FrameLogWriter, read_log
from hil.bus_tools import BusToolError, Monitor, frames_of, is_virtual, play
from hil.cli import main
from sim_backend.hub import UnixHub
from tests.drivers.conftest import RunningHub
from tests.hil.lab import one_line, wait_until

AXES = [Cia402Settings(node_id=1, rated_torque_Nm=5.0, torque_max_Nm=15.0)]
HEARTBEAT = pack_frame(0x701, b"\x7f")
FEEDBACK = pack_frame(0x181, bytes.fromhex("3712000400001E00"))


@pytest.fixture
def hub():
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        running = RunningHub(f"{folder}/bus")
        yield running
        running.stop()


@pytest.mark.parametrize(
    ("address", "answer"),
    [("unix:/tmp/x", True), ("vcan0", True), ("socketcan:vxcan1", True),
     ("python-can:virtual:a", True), ("can0", False), ("socketcan:can1", False),
     ("slcan:/dev/ttyACM0", False), ("python-can:pcan:PCAN_USBBUS1@1000000", False)],
)  # fmt: skip
def test_is_virtual__only_what_exists_in_software(address, answer):
    assert is_virtual(address) is answer


def test_is_virtual__no_address__refused():
    with pytest.raises(BusAddressError):
        is_virtual("usb:1")


# --- monitor --------------------------------------------------------------------------------------


def test_monitor__lines__as_candump_with_decoded_fields():
    line = Monitor(FrameDecoder(AXES)).take(12.5, FEEDBACK)
    assert line == (
        "(12.500000) 181#3712000400001E00      J1_TPDO1 State='operation enabled' Remote "
        "FollowsCommand Position=1.5708 rad Torque=0.15 Nm"
    )


def test_monitor__raw__bytes_alone():
    assert Monitor(None).take(0.0, FEEDBACK) == "(0.000000) 181#3712000400001E00"


def test_monitor__often_seen_identifier__one_line_per_interval():
    monitor = Monitor(None, interval_s=0.25)
    lines = [monitor.take(k * 0.0625, FEEDBACK) for k in range(20)]
    assert [k for k, line in enumerate(lines) if line] == [0, 4, 8, 12, 16]
    assert monitor.take(1.2, HEARTBEAT) is not None  # another identifier has its own interval


def test_monitor__table__counts_and_rates_by_identifier():
    now = [100.0]
    monitor = Monitor(FrameDecoder(AXES), now_s=lambda: now[0])
    for _ in range(40):
        monitor.take(0.0, FEEDBACK)
    monitor.take(0.0, HEARTBEAT)
    now[0] = 102.0
    head, feedback, heartbeat = monitor.table().splitlines()
    assert head.endswith("41 frames")
    assert feedback.split()[:3] == ["181#3712000400001E00", "40", "20.0"]
    assert "J1_TPDO1" in feedback
    assert heartbeat.split()[1:3] == ["1", "0.5"]
    now[0] = 103.0
    assert monitor.table().splitlines()[1].split()[1:3] == ["40", "0.0"]


def test_frames_of__frames_and_silence__in_order_until_ended(hub):
    seen = []
    with open_bus(hub.address) as sender, open_bus(hub.address) as bus:
        stream = frames_of(bus, lambda: len(seen) >= 3)
        assert next(stream) is None  # nothing yet
        for frame in (HEARTBEAT, FEEDBACK, HEARTBEAT):
            sender.send(frame)
        while len(seen) < 3:
            item = next(stream)
            seen += [] if item is None else [item[1]]
    assert seen == [HEARTBEAT, FEEDBACK, HEARTBEAT]


# --- play -----------------------------------------------------------------------------------------


def test_play__own_pace__never_ahead_of_the_log(hub):
    log = [(1000.0 + 0.05 * k, pack_frame(0x100 + k)) for k in range(5)]
    with open_bus(hub.address) as listener, open_bus(hub.address) as bus:
        done = play(bus, log, is_fast=False)
        heard = [listener.recv(5.0) for _ in log]
    assert heard == [frame for _, frame in log]
    assert done.frames == 5
    assert done.duration_s >= 0.2
    assert 0.0 <= done.late_s <= done.duration_s


def test_play__fast__all_frames_in_order_without_waiting(hub):
    log = [(10.0 * k, pack_frame(0x100 + k)) for k in range(200)]
    with open_bus(hub.address) as listener, open_bus(hub.address) as bus:
        done = play(bus, log, is_fast=True)
        heard = [listener.recv(5.0) for _ in log]
    assert heard == [frame for _, frame in log]
    assert done.frames == 200
    assert done.duration_s < 10.0  # the log spans half an hour


def test_play__error_reports__left_out_and_counted(hub):
    log = [(0.0, pack_frame(ERR_FLAG | 4, bytes(8))), (0.0, HEARTBEAT)]
    with open_bus(hub.address) as bus:
        done = play(bus, log, is_fast=True)
    assert (done.frames, done.skipped) == (1, 1)


def test_play__told_to_end__stops_within_the_wait(hub):
    log = [(0.0, HEARTBEAT), (3600.0, HEARTBEAT)]
    with open_bus(hub.address) as bus:
        start_s = monotonic()
        done = play(bus, log, is_fast=False, is_ended=lambda: monotonic() - start_s > 0.1)
    assert done.frames == 1


def test_play__bus_that_takes_nothing__one_line_after_a_second():
    """A hub that nobody serves any more: its queue fills and stays full."""
    with (
        tempfile.TemporaryDirectory(prefix="hil-") as folder,
        UnixHub(f"{folder}/bus") as hub,
        open_bus(f"unix:{folder}/bus") as bus,
    ):
        hub.wait(0.0)
        endless = ((0.0, HEARTBEAT) for _ in range(10_000_000))
        with pytest.raises(BusToolError, match="took no frame for 1 s"):
            play(bus, endless, is_fast=True)


def test_play__logged_by_us__comes_back_the_same(hub, tmp_path):
    path = tmp_path / "x.blf"
    frames = [pack_frame(0x100 + k, bytes(k)) for k in range(9)]
    with FrameLogWriter(path) as writer:
        for k, frame in enumerate(frames):
            writer.write(frame, 50.0 + k)
    other = LoopbackBus()
    bus = LoopbackBus()
    bus.connect(other.deliver)
    play(bus, read_log(path), is_fast=True)
    assert [other.recv(0.0) for _ in frames] == frames


# --- the command line -----------------------------------------------------------------------------


def failure(capsys, *arguments):
    assert main(["bus", *arguments]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    return line


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["monitor", "--bus", "unix:/no/such"], "no bus at unix:/no/such"),
        (["log", "x.txt", "--bus", "unix:/no/such"], "the suffix chooses the format"),
        (["play", "/no/such.log"], "/no/such.log: No such file or directory"),
        (["play", "x.log", "--bus", "can0"], "can0 may have real amplifiers on it"),
        (["dbc", "--out", "/no/such/x.dbc"], "/no/such/x.dbc: No such file or directory"),
        (["monitor", "--set", "axes.9.node_id=1"], "axes.9"),
    ],
    ids=" ".join,
)  # fmt: skip
def test_bus__asked_for_the_impossible__one_line_and_status_1(capsys, arguments, words):
    line = failure(capsys, *arguments)
    assert line.startswith("hil: ")
    assert words in line


def test_bus_play__log_without_frames__refused(capsys, tmp_path):
    path = tmp_path / "x.log"
    path.write_text("")
    assert "there are no frames in it" in failure(capsys, "play", str(path))


def test_bus_dbc__of_configured_axes__read_by_cantools(capsys):
    arguments = ["--set", "axes.1.node_id=9", "--set", "axes.2.family=odrive"]
    assert main(["bus", "dbc", *arguments]) == 0
    database = cantools.database.load_string(capsys.readouterr().out, "dbc")
    identifiers = {message.name: message.frame_id for message in database.messages}
    assert identifiers["J1_TPDO1"] == 0x189
    assert identifiers["J2_InputTorque"] == 2 << 5 | 0x0E


def test_bus_eds__as_written__read_by_canopen(capsys):
    assert main(["bus", "eds"]) == 0
    text = io.StringIO(capsys.readouterr().out)
    text.name = "x.eds"
    assert (
        canopen.import_od(text, node_id=1)[0x6071].data_type == canopen.objectdictionary.INTEGER16
    )


def test_bus_log__as_a_process__python_can_reads_what_was_on_the_bus(hub, tmp_path, lab):
    path = tmp_path / "x.asc"
    process = lab.start("bus", "log", str(path), "--bus", hub.address)
    assert process.wait_for_line() == f"logging {hub.address} to {path}"
    with open_bus(hub.address) as sender:
        for frame in (HEARTBEAT, FEEDBACK):
            sender.send(frame)
        wait_until(lambda: len(hub.frames) == 2, what="the frames on the bus")
    assert process.end(signal.SIGINT) == 0
    assert process.stdout.splitlines()[-1] == f"2 frames in {path}"
    with can.LogReader(path) as reader:
        assert [m.arbitration_id for m in reader] == [0x701, 0x181]


def test_bus_monitor__as_a_process__lines_until_the_signal(hub, lab):
    process = lab.start("bus", "monitor", "--every", "0", "--bus", hub.address)
    with open_bus(hub.address) as sender:

        def is_following():
            sender.send(HEARTBEAT)
            return len(process.stdout.splitlines()) >= 3

        wait_until(is_following, 40.0, "three lines")
    assert process.end(signal.SIGTERM) == 0
    lines = process.stdout.splitlines()
    assert all(line.endswith("J1_Heartbeat NmtState=pre-operational") for line in lines)
    times = [float(line[1 : line.index(")")]) for line in lines]
    assert all(earlier <= later for earlier, later in pairwise(times))


def test_bus_monitor__emulator_goes__one_line_and_status_1(hub, lab):
    process = lab.start("bus", "monitor", "--raw", "--bus", hub.address)
    with open_bus(hub.address) as sender:

        def is_following():
            sender.send(FEEDBACK)
            return "181#" in process.stdout

        wait_until(is_following, 40.0, "a line")
    hub.stop()
    assert process.wait() == 1
    assert "the emulator has closed it" in one_line(process)


def test_bus_play__as_a_process__others_hear_the_log(hub, tmp_path, lab):
    path = tmp_path / "x.log"
    path.write_text("(5.000000) can0 201#0F001E00\n(5.050000) can0 080#\n")
    with open_bus(hub.address) as listener:
        process = lab.start("bus", "play", str(path), "--bus", hub.address)
        assert process.wait() == 0, process.stderr
        heard = [unpack_frame(listener.recv(5.0)) for _ in range(2)]
    assert heard == [(0x201, b"\x0f\x00\x1e\x00"), (0x080, b"")]
    assert process.stdout.startswith("2 frames sent in 0.0")
