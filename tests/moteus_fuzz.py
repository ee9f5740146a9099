"""Random and mutated moteus payloads; the nightly run asks for more of them.

`HIL_TEST_MOTEUS_FUZZ_FRAMES=1000000` frames per side, `HIL_TEST_SEED` repeats a run.
"""

import os
import time

import pytest

from drivers.frame import FD_LENGTHS
from drivers.moteus import codec

FUZZ_FRAMES = int(os.environ.get("HIL_TEST_MOTEUS_FUZZ_FRAMES", "10000"))


def fuzz_seed():
    return int(os.environ.get("HIL_TEST_SEED", time.time_ns() & 0xFFFF_FFFF))


@pytest.fixture
def say(capsys):
    """Print a line past pytest's capturing."""

    def print_line(line):
        with capsys.disabled():
            os.write(1, f"\n{line}\n".encode())

    return print_line


def babble(chance, good):
    """Payload: random bytes, or good ones joined, with some bits, bytes or the end changed."""
    kind = chance.randrange(4)
    if kind == 0:
        return chance.randbytes(chance.choice(FD_LENGTHS))
    data = bytearray(b"".join(chance.choices(good, k=chance.randint(1, 3)))[:64])
    if kind == 1:
        for _ in range(chance.randint(1, 3)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    elif kind == 2:
        data[chance.randrange(len(data))] = chance.randrange(256)
    else:
        del data[chance.randint(1, len(data)) :]
    return codec.pad(bytes(data))
