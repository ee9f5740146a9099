"""More frames than the loop can read: a cycle ends all the same, and nothing stale is used."""

import pytest

from drivers.arm_bus import FLOOD_FRAMES, OVERDUE_FRAMES
from drivers.cia402 import codec
from drivers.frame import pack_frame
from tests.drivers.cia402_rig import Rig

FOREIGN = pack_frame(0x555, bytes(8))
FORGED = pack_frame(codec.COB_TPDO1 + 1, codec.TPDO1.pack(0x1237, 1000, 0))


@pytest.fixture
def rig():
    rig = Rig().enable()
    assert rig.cycle()
    return rig


def flood(rig, frame):
    """From now on there is always one more frame to read."""
    rig.on_wait = lambda: rig.loopback.deliver(frame)


def test_cycle__endless_foreign_frames__ends_without_feedback(rig):
    flood(rig, FOREIGN)
    assert rig.cycle(1.0, 1.0) is False
    assert [axis.age_cycles for axis in rig.axes] == [1, 1]
    assert rig.bus.unknown_frames == FLOOD_FRAMES
    assert rig.commands(1)[-1][1] == 200  # the command goes out nevertheless, per mille of 5 Nm
    assert not any(rig.cycle() for _ in range(3))
    assert min(axis.age_cycles for axis in rig.axes) > 0


def test_collect__endless_frames_after_the_deadline__gives_up(rig):
    rig.bus.request_feedback()
    rig.loopback._queue.clear()
    flood(rig, FOREIGN)
    assert rig.bus.collect(rig.clock_ns) is False
    assert rig.bus.unknown_frames == OVERDUE_FRAMES


def test_cycle__backlog_of_feedback_longer_than_the_limit__none_of_it_counts_as_fresh(rig):
    for _ in range(FLOOD_FRAMES + 50):
        rig.loopback.deliver(FORGED)
    assert rig.cycle() is False
    assert rig.axes[0].age_cycles > 0
    assert rig.axes[1].age_cycles > 0
    assert rig.cycle() is True  # the rest was taken as leftovers
    assert rig.axes[0].q_rad != pytest.approx(1000 * rig.axes[0]._rad_per_count)


def test_cycle__flood_is_over__feedback_is_fresh_again(rig):
    flood(rig, FOREIGN)
    rig.cycles(3)
    rig.on_wait = lambda: None
    rig.cycle()
    assert rig.cycle() is True
    assert rig.all_are("ENABLED")
