"""The data sheet: generated, shipped, read by canopen, and true to the drive."""

import re

import canopen
import pytest

from drivers.cia402 import sdo
from sim_backend.cia402 import eds
from sim_backend.cia402.objects import ENTRIES
from tests.sim_backend.cia402_bench import NODE, Bench


@pytest.fixture
def bench():
    return Bench()


def test_eds__shipped_file__is_what_the_tables_say():
    assert eds.EDS_PATH.read_text() == eds.render_eds()


def test_eds__read_by_canopen__holds_every_entry(bench):
    od = canopen.import_od(str(eds.EDS_PATH), node_id=NODE)
    for entry in ENTRIES:
        found = od.get_variable(entry.index, entry.subindex)
        assert found is not None, f"{entry.index:04X}:{entry.subindex}"
        assert found.pdo_mappable == bool(entry.pdo)
        assert found.writable == (entry.access == "rw")
        if entry.default is not None and found.fixed_size:
            answer = bench.request(sdo.sdo_upload_request(entry.index, entry.subindex))
            assert found.decode_raw(answer.data) == found.default
    assert len({entry.index for entry in ENTRIES}) == len(od)


def test_eds__object_lists__are_numbered_without_gaps():
    text = eds.render_eds()
    for section in ("MandatoryObjects", "OptionalObjects", "ManufacturerObjects"):
        body = re.search(rf"\[{section}\]\nSupportedObjects=(\d+)\n(.*?)\n\n", text, re.DOTALL)
        numbers = [int(line.partition("=")[0]) for line in body[2].splitlines()]
        assert numbers == list(range(1, int(body[1]) + 1))
