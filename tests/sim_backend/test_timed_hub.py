"""The Unix bus with the wire model: delays by the clock, priorities, bus-off, last words."""

import tempfile
import time

import pytest

from drivers.buses.unix import UnixBus
from drivers.frame import pack_frame, unpack_frame
from sim_backend.can_controller import CLASS_BUS_OFF, CLASS_RESTARTED
from sim_backend.settings import WireSettings
from sim_backend.timed_hub import TimedHub
from sim_backend.wire_bits import frame_bits

WAIT_S = 5.0
SLOW = 10_000  # bit/s: a frame takes milliseconds, so that the clock can be asked
QUESTION, ANSWER = pack_frame(0x80), pack_frame(0x181, b"\x01")


@pytest.fixture
def make():
    with tempfile.TemporaryDirectory(prefix="hil-") as folder:
        hubs = []

        def make(bit_rate=SLOW, **setting):
            wire = WireSettings(is_on=True, **setting)
            hub = TimedHub(f"{folder}/bus", wire, bit_rate=bit_rate, data_bit_rate=bit_rate)
            hubs.append(hub)
            return hub

        yield make
        for hub in hubs:
            hub.close()


def join(hub):
    client = UnixBus(hub.path)
    hub.wait(0.0)
    return client


def serve(hub, is_done):
    """Let the hub work until a condition holds; return what reached the amplifiers."""
    frames = []
    deadline_s = time.monotonic() + WAIT_S
    while not is_done():
        assert time.monotonic() < deadline_s, "time is up"
        frames += hub.wait(0.01)
    return frames


def test_timed_hub__frame_from_a_client__arrives_everywhere_when_its_bits_are_over(make):
    hub = make()
    with join(hub) as sender, join(hub) as other:
        start_s = time.monotonic()
        sender.send(QUESTION)
        while not (frames := hub.wait(1e-3)):
            assert other.recv(0.0) is None
        assert time.monotonic() - start_s >= (frame_bits(QUESTION) - 3) / SLOW
        assert frames == [QUESTION]
        assert other.recv(0.0) == QUESTION
        assert sender.recv(0.0) is None


def test_timed_hub__answer_of_an_amplifier__counts_from_the_questions_arrival(make):
    hub = make()
    (port,) = hub.ports(1)
    with join(hub) as client:
        client.send(QUESTION)
        assert serve(hub, lambda: hub.model.total.frames) == [QUESTION]
        arrival_ns = hub.model.now_ns
        time.sleep(0.002)  # the emulator is slow; the amplifier is not
        port.send(ANSWER)
        while client.stats.frames_received == 0:
            hub.wait(0.0)
            client.recv(0.0)
        duration_ns = (3 + frame_bits(ANSWER) - 3) * 1_000_000_000 // SLOW
        assert hub.model.total.frames == 2
        assert hub.model.total.wait_max_ns <= 3 * 1_000_000_000 // SLOW
        assert hub.model.now_ns - arrival_ns >= duration_ns


def test_timed_hub__frames_that_wait__go_by_identifier(make):
    hub = make()
    with join(hub) as sender, join(hub) as other:
        low, high = pack_frame(0x700), pack_frame(0x100)
        sender.send(low)
        other.send(high)
        assert serve(hub, lambda: hub.model.total.frames == 2) == [high, low]


def test_timed_hub__client_leaves__what_it_sent_last_still_arrives(make):
    hub = make()
    with join(hub) as stays:
        leaves = join(hub)
        leaves.send(QUESTION)
        leaves.send(ANSWER)
        leaves.close()
        frames = serve(hub, lambda: hub.model.total.frames == 2)
        assert sorted(frames) == sorted([QUESTION, ANSWER])
        assert stays.recv(0.0) is not None
        assert len(hub.clients) == 1


def test_timed_hub__client_bus_off__is_told_cut_off_and_told_again(make):
    hub = make()
    with join(hub) as client, join(hub) as other:
        controller = hub.controller_of(0)
        client.send(QUESTION)
        hub.model.force_bus_off(controller)  # for 140 ms
        hub.wait(0.0)
        assert controller.frames_dropped == 1
        can_id, data = unpack_frame(client.recv(0.0))
        assert can_id & CLASS_BUS_OFF
        assert data[6] == 255
        serve(hub, lambda: not controller.is_bus_off)
        assert unpack_frame(client.recv(0.0))[0] & CLASS_RESTARTED
        client.send(QUESTION)
        assert serve(hub, lambda: hub.model.total.frames == 1) == [QUESTION]
        assert other.recv(0.0) == QUESTION
        assert client.stats.error_frames == 2


def test_timed_hub__bit_errors__every_client_hears_of_them_and_frames_arrive(make):
    hub = make(bit_rate=1_000_000)
    with join(hub) as sender, join(hub) as other:
        hub.model.fail_next(hub.controller_of(0), 2)
        sender.send(QUESTION)
        assert serve(hub, lambda: hub.model.total.frames == 1) == [QUESTION]
        assert hub.model.total.errors == 2
        received = [other.recv(0.0) for _ in range(3)]
        assert received[2] == QUESTION
        assert other.stats.error_frames == 2


def test_timed_hub__wait_without_traffic__takes_the_time_asked(make):
    hub = make()
    start_s = time.monotonic()
    assert hub.wait(0.05) == []
    assert time.monotonic() - start_s >= 0.05
