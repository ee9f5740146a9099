"""The same run gives the same bytes: in other processes, directories and hash seeds, on other
versions of Python. What differs is told by cycle and field.

The default run takes the first moment of every case; HIL_NIGHTLY=1 takes whole scenarios.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hil.diff import first_parting
from hil.recording import Recording
from tests.hil.determinism import CASES
from tests.hil.lab import HilProcess

ROOT = Path(__file__).parents[2]
IS_NIGHTLY = bool(os.environ.get("HIL_NIGHTLY"))
LENGTH = ["--whole"] if IS_NIGHTLY else []
TIMEOUT_S = 1800 if IS_NIGHTLY else 100
OTHER_PYTHONS = ("3.12", "3.13", "3.14")


class Simulated:
    """Every case, run by one interpreter in a directory and with a hash seed of its own."""

    def __init__(self, directory, python=sys.executable, seed="0"):
        self.directory = directory
        clean = {k: v for k, v in os.environ.items() if not k.startswith(("HIL_", "PYTHON"))}
        done = subprocess.run(
            [python, "-m", "tests.hil.determinism", str(directory), *LENGTH],
            cwd=directory,
            env=clean | {"PYTHONPATH": str(ROOT), "PYTHONHASHSEED": seed},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        told = json.loads(done.stdout)
        self.python, self.digests = told["python"], told["digests"]

    def require_same(self, other, case):
        """Fail with the first differing cycle and field of a case."""
        if self.digests[case] == other.digests[case]:
            return
        a, b = (Recording.open(of.directory / f"{case}.mcap") for of in (self, other))
        parted = [difference.text() for difference in first_parting(a, b, with_timing=True)]
        pytest.fail(f"{case}: {self.python} against {other.python}: {'; '.join(parted)}")


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return Simulated(tmp_path_factory.mktemp("first"))


@pytest.fixture(scope="module")
def second(tmp_path_factory):
    deep = tmp_path_factory.mktemp("second") / "a directory" / "elsewhere"
    deep.mkdir(parents=True)
    return Simulated(deep, seed="4242")


@pytest.mark.timeout(2 * TIMEOUT_S + 20)
@pytest.mark.parametrize("case", CASES)
def test_simulation__other_process_directory_hash_seed__same_bytes(first, second, case):
    first.require_same(second, case)
    a, b = ((run.directory / f"{case}.mcap").read_bytes() for run in (first, second))
    assert a == b  # the whole file, framing and index too


def test_simulation__cases__are_different_runs(first):
    """What would be equal whatever happens proves nothing."""
    digests = [tuple(first.digests[case].values()) for case in CASES]
    assert len(set(digests)) == len(digests)


def test_sim__command_twice__same_file(tmp_path):
    request = {"kind": "kelly", "duration_s": 0.5, "rate": 0.25, "approach": "none"}
    files = []
    for seed in ("1", "77"):
        place = tmp_path / seed
        place.mkdir()
        (place / "kelly.json").write_text(json.dumps(request))
        arguments = ["sim", "--trajectory", "kelly.json", "--set", "plant.q0_rad=[0.4,-0.5]"]
        process = HilProcess(place, *arguments, "--record", f"{seed}.mcap", PYTHONHASHSEED=seed)
        process.wait(60)
        files.append((place / f"{seed}.mcap").read_bytes())
    assert files[0] == files[1]
    assert len(files[0]) > 50_000


def test_require_same__one_gain_changed__names_cycle_and_field(first, tmp_path):
    """The instrument itself: a difference is found and told."""
    other = Simulated.__new__(Simulated)
    other.directory, other.python, other.digests = tmp_path, "another", {"A": {}}
    shutil.copy(first.directory / "B.mcap", tmp_path / "A.mcap")
    with pytest.raises(pytest.fail.Exception, match=r"A: CPython .* against another: in cycle \d+"):
        first.require_same(other, "A")


def interpreter(version):
    """Return an interpreter of that version that has the program's dependencies, or skip."""
    given = os.environ.get("HIL_TEST_PYTHONS", "").split(os.pathsep)
    made = [str(ROOT / ".venv" / "pythons" / version / "bin" / "python")]
    for candidate in [*filter(None, given), *made]:
        if Path(candidate).exists() and runs_the_program(candidate, version):
            return candidate
    pytest.skip(
        f"no Python {version} with the program's dependencies; `make pythons` makes one from "
        f"python{version}, or name some in HIL_TEST_PYTHONS"
    )


def runs_the_program(python, version):
    code = "import sys, hil.simulation; print('%d.%d' % sys.version_info[:2])"
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [python, "-c", code], env=environment, capture_output=True, text=True, check=False
    )
    return done.stdout.strip() == version


@pytest.mark.timeout(2 * TIMEOUT_S + 20)
@pytest.mark.parametrize("version", OTHER_PYTHONS)
def test_simulation__other_version_of_python__same_bytes(first, tmp_path, version):
    other = Simulated(tmp_path, interpreter(version), seed="99")
    assert version in other.python
    for case in CASES:
        first.require_same(other, case)
