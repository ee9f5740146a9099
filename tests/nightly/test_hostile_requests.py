"""A hundred thousand hostile requests to a moving arm: `make nightly`.

`HIL_HOSTILE_REQUESTS` changes their number, `HIL_TEST_SEED` repeats a run.
"""

import os
import sys

import pytest

from tests.hil.lab import Lab
from tests.hil.test_hostile_requests import attack

REQUESTS = int(os.environ.get("HIL_HOSTILE_REQUESTS", "100000"))

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not os.environ.get("HIL_NIGHTLY"), reason="takes minutes: `make nightly` (HIL_NIGHTLY=1)"
    ),
    pytest.mark.timeout(120 + REQUESTS / 20),
]


def test_requests__hostile__answered_and_no_torque_beyond_its_limit(tmp_path, capsys):
    lab = Lab(tmp_path)
    try:
        with capsys.disabled():
            attack(lab, REQUESTS, sys.stdout.write)
    finally:
        lab.close()
