"""Places to run emulators and daemons in; see `tests.hil.lab`."""

import pytest

from tests.hil.lab import Lab


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
