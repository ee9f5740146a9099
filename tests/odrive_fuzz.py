"""Random and mutated CANSimple payloads; the nightly run asks for more of them.

`HIL_TEST_ODRIVE_FUZZ_FRAMES=1000000` frames per side, `HIL_TEST_SEED` repeats a run.
"""

import os
import random
import sys
import time

FUZZ_FRAMES = int(os.environ.get("HIL_TEST_ODRIVE_FUZZ_FRAMES", "20000"))


def random_source(capsys, what):
    """A seeded source, its seed and the number of frames printed past pytest's capturing."""
    seed = int(os.environ.get("HIL_TEST_SEED", time.time_ns() & 0xFFFF_FFFF))
    counts = f"HIL_TEST_SEED={seed} HIL_TEST_ODRIVE_FUZZ_FRAMES={FUZZ_FRAMES}"
    with capsys.disabled():
        sys.stdout.write(f"\n{what}: {counts}\n")
    return random.Random(seed)


def babble(chance, good):
    """(command, payload): random, or one of the good ones, often with bits or its end changed."""
    if chance.random() < 0.2:
        return chance.randrange(32), chance.randbytes(chance.randrange(9))
    command, data = chance.choice(good)
    data = bytearray(data)
    kind = chance.randrange(4)
    if data and kind == 1:
        for _ in range(chance.randint(1, 3)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif data and kind == 2:
        data[chance.randrange(len(data))] = chance.choice((0, 0x7F, 0x80, 0xC0, 0xFF))
    elif data and kind == 3:
        del data[chance.randrange(len(data)) :]
    return command, bytes(data)
