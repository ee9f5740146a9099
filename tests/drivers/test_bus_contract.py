"""What every bus back-end promises (`drivers.bus.Bus`), one suite over all of them."""

import select
import threading
import time
from functools import partial

import pytest

from drivers.bus import Bus
from drivers.errors import BusError
from drivers.frame import (
    EFF_FLAG,
    ERR_FLAG,
    FD_BRS,
    FD_ESI,
    RTR_FLAG,
    pack_fd_frame,
    pack_frame,
    unpack_frame,
)

WAIT_S = 5.0  # for what must come; the machine may be busy
KINDS = {
    "no_data": pack_frame(0x080),
    "eight_bytes": pack_frame(0x181, bytes(range(8))),
    "highest_id": pack_frame(0x7FF, b"\xff"),
    "extended": pack_frame(0x1234_5678 | EFF_FLAG, b"\x01\x02"),
    "extended_small": pack_frame(0x7FF | EFF_FLAG, b"\x01"),
    "remote": pack_frame(0x701 | RTR_FLAG),
    "remote_of_four": pack_frame(0x701 | RTR_FLAG, bytes(4)),
    "extended_remote": pack_frame(0x1FFF_FFFF | EFF_FLAG | RTR_FLAG),
}

FD_KINDS = {
    "fd_no_data": pack_fd_frame(0x123),
    "fd_eight_bytes": pack_fd_frame(0x7FF, bytes(range(8))),
    "fd_sixty_four_bytes": pack_fd_frame(0x8001 | EFF_FLAG, bytes(range(64))),
    "fd_one_bit_rate": pack_fd_frame(0x8001 | EFF_FLAG, bytes(range(20)), flags=0),
    "fd_error_passive": pack_fd_frame(0x101, bytes(12), flags=FD_BRS | FD_ESI),
}

only = partial(pytest.mark.parametrize, "wiring", indirect=True)
many_ends = only(argvalues=["unix", "python-can", "slcan", "socketcan"])
with_fd = only(argvalues=["unix", "loopback", "python-can", "socketcan"])
that_wait = only(argvalues=["unix", "python-can", "slcan", "socketcan"])
with_descriptor = only(argvalues=["unix", "socketcan"])
that_can_break = only(argvalues=["unix", "slcan", "socketcan"])


def receive(bus: Bus, number: int) -> list[bytes]:
    frames = []
    for _ in range(number):
        frame = bus.recv(WAIT_S)
        if frame is None:
            break
        frames.append(frame)
    return frames


@pytest.mark.parametrize("kind", KINDS)
def test_bus__frame_of_each_kind__arrives_unchanged(wiring, kind):
    sender, receiver = wiring.join(), wiring.join()
    assert sender.send(KINDS[kind]) is True
    assert receiver.recv(WAIT_S) == KINDS[kind]


@with_fd
@pytest.mark.parametrize("kind", FD_KINDS)
def test_bus__can_fd_frame_of_each_kind__arrives_unchanged_between_classic_ones(wiring, kind):
    sender, receiver = wiring.join(), wiring.join()
    assert sender.carries_fd
    frames = [KINDS["eight_bytes"], FD_KINDS[kind], KINDS["no_data"]]
    assert [sender.send(frame) for frame in frames] == [True] * 3
    assert receive(receiver, 3) == frames
    assert receiver.stats.malformed_records == 0


def test_bus__both_directions__each_gets_the_others(wiring):
    left, right = wiring.join(), wiring.join()
    left.send(pack_frame(1))
    right.send(pack_frame(2))
    assert (left.recv(WAIT_S), right.recv(WAIT_S)) == (pack_frame(2), pack_frame(1))


@many_ends
def test_bus__three_participants__both_others_receive(wiring):
    sender, first, second = wiring.join(), wiring.join(), wiring.join()
    sender.send(KINDS["eight_bytes"])
    assert first.recv(WAIT_S) == second.recv(WAIT_S) == KINDS["eight_bytes"]


def test_bus__burst_read_afterwards__complete_and_in_order(wiring):
    number = min(wiring.holds_frames, 1000)  # by net.core.wmem_max, or the buffers of a pty
    assert number >= 100
    sender, receiver = wiring.join(), wiring.join()
    burst = [pack_frame(i % 0x700, i.to_bytes(8, "little")) for i in range(number)]
    assert [sender.send(frame) for frame in burst] == [True] * number
    assert receive(receiver, number) == burst
    assert receiver.stats.frames_received == number
    assert receiver.stats.receive_overflows == 0


def test_bus__own_frames__do_not_come_back(wiring):
    sender, receiver = wiring.join(), wiring.join()
    sender.send(pack_frame(1))
    receiver.recv(WAIT_S)
    receiver.send(pack_frame(2))
    assert sender.recv(WAIT_S) == pack_frame(2)
    assert sender.recv(0.0) is None


@that_wait
def test_recv__nothing_comes__waits_the_time_out_and_not_much_longer(wiring):
    bus = wiring.join()
    began_s = time.monotonic()
    assert bus.recv(0.02) is None
    took_s = time.monotonic() - began_s
    assert 0.02 <= took_s < 1.0


@pytest.mark.parametrize("timeout_s", [0.0, -0.001])
def test_recv__no_time_left__returns_at_once(wiring, timeout_s):
    bus = wiring.join()
    began_s = time.monotonic()
    assert bus.recv(timeout_s) is None
    assert time.monotonic() - began_s < 1.0


@that_wait
def test_recv__frame_comes_while_waiting__is_returned(wiring):
    sender, receiver = wiring.join(), wiring.join()
    timer = threading.Timer(0.02, sender.send, [KINDS["eight_bytes"]])
    timer.start()
    assert receiver.recv(WAIT_S) == KINDS["eight_bytes"]
    timer.join()


@with_descriptor
def test_fileno__frame_waits__is_readable_until_it_is_read(wiring):
    sender, receiver = wiring.join(), wiring.join()
    fd = receiver.fileno()
    assert select.select([fd], [], [], 0.0)[0] == []
    sender.send(pack_frame(1))
    sender.send(pack_frame(2))
    for _ in range(2):
        assert select.select([fd], [], [], WAIT_S)[0] == [fd]
        assert receiver.recv(0.0) is not None
    assert select.select([fd], [], [], 0.0)[0] == []


def test_stats__frames_sent_and_received__are_counted(wiring):
    sender, receiver = wiring.join(), wiring.join()
    for _ in range(3):
        sender.send(pack_frame(1))
    receive(receiver, 3)
    assert (sender.stats.frames_sent, sender.stats.frames_received) == (3, 0)
    assert (receiver.stats.frames_sent, receiver.stats.frames_received) == (0, 3)
    assert sender.stats.send_failures == receiver.stats.error_frames == 0


def test_stats__error_report__is_handed_over_and_counted_apart(wiring):
    sender, receiver = wiring.join(), wiring.join()
    wiring.report(sender, pack_frame(ERR_FLAG | 0x40, bytes(8)))  # CAN_ERR_BUSOFF
    sender.send(pack_frame(1))
    can_ids = [unpack_frame(frame)[0] for frame in receive(receiver, 2)]
    assert can_ids == [ERR_FLAG | 0x40, 1]
    assert (receiver.stats.frames_received, receiver.stats.error_frames) == (1, 1)


def test_bus__closed__refuses_use_with_one_line(wiring):
    bus = wiring.join()
    bus.close()
    bus.close()
    for use in (lambda: bus.send(pack_frame(1)), lambda: bus.recv(0.0), lambda: bus.recv(0.01)):
        with pytest.raises(BusError, match="closed") as caught:
            use()
        assert "\n" not in str(caught.value)
    assert bus.fileno() == -1
    assert bus.stats.frames_sent == 0


@many_ends
def test_bus__other_participant_leaves__stays_usable(wiring):
    sender, leaver, receiver = wiring.join(), wiring.join(), wiring.join()
    leaver.close()
    sender.send(pack_frame(1))
    assert receiver.recv(WAIT_S) == pack_frame(1)


@that_can_break
def test_bus__wire_taken_away__both_directions_raise(wiring):
    if wiring.cut is None:
        pytest.skip("not allowed to make a vcan interface and take it down")
    bus = wiring.join()
    peer = wiring.join()
    peer.send(pack_frame(1))
    assert bus.recv(WAIT_S) == pack_frame(1)
    wiring.cut()
    with pytest.raises(BusError, match=r"gone|down"):
        bus.recv(WAIT_S)
    with pytest.raises(BusError, match=r"gone|down"):
        bus.send(pack_frame(1))
    assert bus.stats.frames_sent == 0
