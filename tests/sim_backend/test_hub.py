import os
import socket
import stat
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from drivers.bus import open_bus
from drivers.buses.loopback import LoopbackBus
from drivers.buses.unix import UnixBus
from drivers.errors import BusError
from drivers.frame import EFF_FLAG, pack_fd_frame, pack_frame, unpack_frame
from sim_backend.errors import SimError
from sim_backend.hub import BusWire, UnixHub, open_wire

WAIT_S = 5.0
QUESTION, ANSWER = pack_frame(0x80), pack_frame(0x181, b"\x01")


@pytest.fixture
def path() -> Iterator[str]:
    """Short enough for a Unix socket (107 characters), which pytest's own is not always."""
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        yield f"{folder}/bus"


@pytest.fixture
def hub(path) -> Iterator[UnixHub]:
    with UnixHub(path) as hub:
        yield hub


def collect(hub: UnixHub, number: int) -> list[bytes]:
    frames: list[bytes] = []
    while len(frames) < number:
        batch = hub.wait(WAIT_S)
        assert batch, "time is up"
        frames += batch
    return frames


# --- the wire


def test_hub__frame_from_a_client__goes_to_emulator_and_other_clients(hub, path):
    with UnixBus(path) as sender, UnixBus(path) as first, UnixBus(path) as second:
        sender.send(QUESTION)
        assert hub.wait(WAIT_S) == [QUESTION]
        assert first.recv(0.0) == second.recv(0.0) == QUESTION
        assert sender.recv(0.0) is None


def test_hub__frame_from_the_emulator__goes_to_all_clients(hub, path):
    with UnixBus(path) as first, UnixBus(path) as second:
        hub.wait(0.0)
        hub.transmit(ANSWER)
        assert first.recv(0.0) == second.recv(0.0) == ANSWER


def test_hub__answer_to_a_client__reaches_others_after_the_question(hub, path):
    with UnixBus(path) as master, UnixBus(path) as logger:
        for _ in range(3):
            master.send(QUESTION)
        for _ in range(3):
            assert hub.wait(WAIT_S) == [QUESTION]
            hub.transmit(ANSWER)
        assert [logger.recv(0.0) for _ in range(6)] == [QUESTION, ANSWER] * 3


def test_hub__frames_queued_by_one_client__come_in_order(hub, path):
    frames = [pack_frame(i) for i in range(100)]
    with UnixBus(path) as client:
        for frame in frames:
            client.send(frame)
        assert collect(hub, 100) == frames


def test_hub__one_client_floods__another_is_heard_in_the_next_wait(hub, path):
    with UnixBus(path) as flooder, UnixBus(path) as quiet:
        for i in range(200):
            flooder.send(pack_frame(i))
        quiet.send(pack_frame(0x7FF))
        assert pack_frame(0x7FF) in hub.wait(WAIT_S)


def test_wait__nothing_comes__keeps_the_time_out(hub, path):
    with UnixBus(path) as client:
        assert hub.wait(0.0) == []
        client._socket.send(b"malformed")
        assert hub.wait(0.01) == []
        assert hub.wait(-1.0) == []


def test_wait__client_connects_meanwhile__goes_on_waiting_for_a_frame(hub, path):
    def join_and_send() -> None:
        with UnixBus(path) as client:
            client.send(QUESTION)

    thread = threading.Thread(target=join_and_send)
    thread.start()
    assert hub.wait(WAIT_S) == [QUESTION]
    thread.join()


# --- clients that misbehave


def test_hub__client_does_not_read__loses_frames_and_holds_up_nobody(hub, path):
    with UnixBus(path) as slow, UnixBus(path) as quick:
        hub.wait(0.0)
        sent = 0
        while not hub.frames_lost:
            hub.transmit(pack_frame(1, sent.to_bytes(8, "little")))
            sent += 1
            assert quick.recv(0.0) is not None
        lost = [stats.frames_lost for stats in hub.clients]
        assert lost == [1, 0]
        delivered = list(iter(lambda: slow.recv(0.0), None))
        assert len(delivered) == sent - 1
        assert unpack_frame(delivered[-1])[1] == (sent - 2).to_bytes(8, "little")
        hub.transmit(ANSWER)
        assert slow.recv(0.0) == ANSWER
    hub.wait(0.0)
    assert hub.frames_lost == 1, "the count outlives the client"


WRONG_SIZES = (0, 1, 15, 17, 71, 73, 5000)


@pytest.mark.parametrize("size", WRONG_SIZES)
def test_hub__record_of_wrong_size__is_dropped_and_counted(hub, path, size):
    with UnixBus(path) as client, UnixBus(path) as other:
        client._socket.send(bytes(size))
        client.send(QUESTION)
        assert collect(hub, 1) == [QUESTION]
        assert [stats.malformed_records for stats in hub.clients] == [1, 0]
        assert [stats.frames_received for stats in hub.clients] == [1, 0]
        assert other.recv(0.0) == QUESTION
        assert other.recv(0.0) is None


def test_hub__client_leaves__others_go_on(hub, path):
    with UnixBus(path) as stayer:
        with UnixBus(path):
            hub.wait(0.0)
            assert len(hub.clients) == 2
        hub.wait(0.0)
        assert len(hub.clients) == 1
        hub.transmit(ANSWER)
        assert stayer.recv(0.0) == ANSWER


def test_hub__can_fd_record__is_relayed_whole_like_any_other(hub, path):
    frame = pack_fd_frame(0x8001 | EFF_FLAG, bytes(range(64)))
    with UnixBus(path) as client, UnixBus(path) as other:
        client.send(QUESTION)
        client.send(frame)
        assert collect(hub, 2) == [QUESTION, frame]
        hub.transmit(frame)
        assert [other.recv(WAIT_S) for _ in range(3)] == [QUESTION, frame, frame]
        assert client.recv(WAIT_S) == frame


def test_hub__client_leaves_with_frames_unread__its_last_frames_still_count(hub, path):
    """A master that sends its stop and closes has feedback in its queue that it never reads."""
    client = UnixBus(path)
    hub.wait(0.0)
    hub.transmit(ANSWER)
    client.send(pack_frame(1))
    client.send(pack_frame(2))
    client.close()
    assert collect(hub, 2) == [pack_frame(1), pack_frame(2)]
    assert hub.wait(0.0) == []
    assert hub.clients == []


def test_hub__client_gone_unnoticed__transmit_does_not_raise(hub, path):
    with UnixBus(path):
        hub.wait(0.0)
    hub.transmit(ANSWER)
    assert hub.wait(0.0) == []
    assert hub.clients == []


def test_hub__too_many_clients__the_last_is_turned_away(hub, path):
    clients = [UnixBus(path)]
    for _ in range(64):
        hub.wait(0.0)
        clients.append(UnixBus(path))
    hub.wait(0.0)
    assert len(hub.clients) == 64
    with pytest.raises(BusError):
        clients[-1].recv(0.0)
    for client in clients:
        client.close()


# --- the socket file


def test_hub__opened__socket_is_for_owner_and_group_only(path):
    before = os.umask(0)
    try:
        with UnixHub(path):
            assert stat.S_IMODE(Path(path).stat().st_mode) == 0o660
    finally:
        os.umask(before)


def test_hub__tight_umask__group_may_still_connect(path):
    before = os.umask(0o077)
    try:
        with UnixHub(path):
            assert stat.S_IMODE(Path(path).stat().st_mode) == 0o660
    finally:
        os.umask(before)


def test_hub__closed__file_is_gone_and_clients_know(path):
    hub = UnixHub(path)
    with UnixBus(path) as client:
        hub.wait(0.0)
        hub.close()
        hub.close()
        assert not Path(path).exists()
        with pytest.raises(BusError, match="gone"):
            client.recv(WAIT_S)
    with pytest.raises(SimError, match="is closed"):
        hub.wait(0.0)


def test_hub__stale_socket_file__is_replaced(path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(path)
    with UnixHub(path) as hub, UnixBus(path) as client:
        client.send(QUESTION)
        assert hub.wait(WAIT_S) == [QUESTION]


def test_hub__another_listens__is_refused_and_the_other_unharmed(hub, path):
    with pytest.raises(SimError, match=f"another emulator already listens on {path}"):
        UnixHub(path)
    with UnixBus(path) as client:
        client.send(QUESTION)
        assert hub.wait(WAIT_S) == [QUESTION]


def test_hub__another_listens_and_is_busy__is_refused(hub, path):
    refusal = ""
    waiting: list[UnixBus] = []
    while not refusal:
        try:
            waiting.append(UnixBus(path))
        except BusError as error:
            refusal = str(error)
    assert "the emulator takes no newcomers: is it stopped?" in refusal
    with pytest.raises(SimError, match="another emulator already listens"):
        UnixHub(path)
    for client in waiting:
        client.close()


@pytest.mark.parametrize("attempt", range(20))
def test_hub__four_start_at_once__one_listens(path, attempt):
    """A loser must not remove the winner's socket as a stale one."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as dead:
        dead.bind(path)
    hubs: list[UnixHub] = []
    refusals: list[SimError] = []
    start = threading.Barrier(4)

    def listen() -> None:
        start.wait()
        try:
            hubs.append(UnixHub(path))
        except SimError as error:
            refusals.append(error)

    threads = [threading.Thread(target=listen) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    try:
        assert (len(hubs), len(refusals)) == (1, 3)
        with UnixBus(path) as client:
            client.send(QUESTION)
            assert hubs[0].wait(WAIT_S) == [QUESTION]
    finally:
        for hub in hubs:
            hub.close()


def test_hub__file_replaced_by_another__close_leaves_it_alone(path):
    hub = UnixHub(path)
    Path(path).unlink()
    with UnixHub(path):
        hub.close()
        assert Path(path).exists()


def test_hub__no_parent_directory__says_so(path):
    with pytest.raises(SimError, match=f"no directory {path} for the bus"):
        UnixHub(f"{path}/bus")


def test_hub__ordinary_file_in_the_way__is_left_alone(path):
    Path(path).write_text("precious")
    with pytest.raises(SimError, match="a file that is no socket is in the way"):
        UnixHub(path)
    assert Path(path).read_text() == "precious"


def test_hub__path_too_long__is_one_clear_line(path):
    with pytest.raises(SimError, match="cannot listen at unix:") as caught:
        UnixHub(f"{path}{'x' * 120}")
    assert "\n" not in str(caught.value)


# --- other buses


def test_open_wire__each_scheme__gives_its_wire(path):
    with open_wire(f"unix:{path}") as wire:
        assert isinstance(wire, UnixHub)
    with open_wire("python-can:virtual:open-wire") as wire:
        assert isinstance(wire, BusWire)
    with pytest.raises(SimError, match="not one of: unix:PATH"):
        open_wire("nonsense:")
    with pytest.raises(SimError, match="no bus python-can:nosuch"):
        open_wire("python-can:nosuch:0")


def test_bus_wire__frames_both_ways__pass_unchanged():
    address = "python-can:virtual:bus-wire"
    with open_wire(address) as wire, open_bus(address) as master:
        master.send(pack_frame(1))
        master.send(pack_frame(2))
        assert wire.wait(WAIT_S) == [pack_frame(1), pack_frame(2)]
        assert wire.wait(0.0) == []
        wire.transmit(ANSWER)
        assert master.recv(WAIT_S) == ANSWER


def test_bus_wire__bus_closed__raises_the_rooms_own_error():
    wire = BusWire(LoopbackBus())
    wire.close()
    with pytest.raises(SimError, match="closed"):
        wire.wait(0.0)
    with pytest.raises(SimError, match="closed"):
        wire.transmit(ANSWER)
