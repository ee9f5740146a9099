"""Places to run emulators and daemons in; see `tests.hil.lab`."""

import pytest
from hypothesis import HealthCheck, settings

from tests.hil.lab import Lab

# A shared machine stalls for tenths of a second: no test may fail for being slow once.
settings.register_profile(
    "shared_machine", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)
settings.load_profile("shared_machine")


@pytest.fixture
def lab(tmp_path):
    """A lab of this test's own."""
    place = Lab(tmp_path)
    yield place
    place.close()


@pytest.fixture(scope="module")
def shared_lab(tmp_path_factory):
    """A lab for all tests of a module."""
    place = Lab(tmp_path_factory.mktemp("lab"))
    yield place
    place.close()
