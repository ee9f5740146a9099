"""Random and mutated MIT-mode payloads; the nightly run asks for more of them.

`HIL_TEST_MIT_FUZZ_FRAMES=1000000` frames per variant and side, `HIL_TEST_SEED` repeats a run.
"""

import os
import random
import sys
import time

FUZZ_FRAMES = int(os.environ.get("HIL_TEST_MIT_FUZZ_FRAMES", "10000"))


def random_source(capsys, what):
    """A seeded source, its seed and the number of frames printed past pytest's capturing."""
    seed = int(os.environ.get("HIL_TEST_SEED", time.time_ns() & 0xFFFF_FFFF))
    with capsys.disabled():
        sys.stdout.write(f"\n{what}: HIL_TEST_SEED={seed} HIL_TEST_MIT_FUZZ_FRAMES={FUZZ_FRAMES}\n")
    return random.Random(seed)


def babble(chance, good):
    """Payload: random bytes, or a good one with some bits, bytes or its end changed."""
    kind = chance.randrange(4)
    if kind == 0:
        return chance.randbytes(chance.randrange(9))
    data = bytearray(good)
    if kind == 1:
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == 2:
        data[chance.randrange(len(data))] = chance.choice((0, 0xFF, 0x33, 0x55, 0xAA, 0xFD))
    else:
        del data[chance.randrange(len(data)) :]
    return bytes(data)
