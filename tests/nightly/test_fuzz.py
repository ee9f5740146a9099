"""A million random frames to both sides of every amplifier family: `make nightly`.

`HIL_FUZZ_FRAMES` changes their number, `HIL_TEST_SEED` repeats a run. The families' own tests
mutate frames they know; here anything comes, in any order, while torque is asked for.
"""

import math
import os
import random
import sys
import time

import pytest

from drivers.axis import AxisStatus
from drivers.frame import EFF_FLAG, pack_frame
from drivers.registry import SETTINGS
from tests.drivers.axis_rig import TICKS, AxisRig

FRAMES = int(os.environ.get("HIL_FUZZ_FRAMES", "1000000"))
PER_CYCLE = 10
TOLERANCE = 1.0 + 1e-9

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not os.environ.get("HIL_NIGHTLY"), reason="takes minutes: `make nightly` (HIL_NIGHTLY=1)"
    ),
    pytest.mark.timeout(60 + FRAMES / 200),
]


def babble(chance, known):
    """A frame with any data: mostly identifiers in use, at times a length no frame has."""
    can_id = chance.choice([*known, chance.getrandbits(11), EFF_FLAG | chance.getrandbits(29)])
    frame = bytearray(pack_frame(can_id, chance.randbytes(8)))
    frame[4] = chance.choice((0, 1, 2, 4, 6, 8, 8, 8, 8, chance.randrange(256)))
    return can_id, bytes(frame)


@pytest.mark.parametrize("family", SETTINGS)
def test_family__random_frames_to_both_sides__no_exception_and_torque_within_limits(family, capsys):
    seed = int(os.environ.get("HIL_TEST_SEED", time.time_ns() & 0xFFFF_FFFF))
    with capsys.disabled():
        sys.stdout.write(f"\n{family}: HIL_TEST_SEED={seed} HIL_FUZZ_FRAMES={FRAMES}\n")
    chance = random.Random(seed)
    rig = AxisRig(family).configure().enable()
    known = [can_id for axis in rig.axes for can_id in list(axis.handlers())[:4]] * 3
    for number in range(FRAMES // PER_CYCLE):
        for _ in range(PER_CYCLE):
            can_id, frame = babble(chance, known)
            rig.loopback.deliver(frame)
            if can_id not in TICKS:
                rig.emulator.receive(frame)
        rig.cycle(chance.uniform(-1e3, 1e3), chance.uniform(-1e3, 1e3))
        for servo, axis in zip(rig.servos, rig.axes, strict=True):
            assert abs(servo.torque_target_Nm) <= servo.torque_max_Nm * TOLERANCE
            assert axis.status in AxisStatus
            assert math.isfinite(axis.q_rad)
        if number % 200 == 0 and not rig.bus.is_enabled:  # to be in every state again and again
            for axis in rig.axes:
                axis.reset_fault()
                axis.enable()
