"""`hil demo`, once and whole: processes, figures, recording and report."""

import re

import numpy as np
import pytest
from matplotlib.image import imread
from mcap.reader import make_reader

from controller.machine import State
from hil.proto import telemetry_pb2
from hil.scenarios import SCENARIOS
from tests.hil.lab import HilProcess, whole


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    process = HilProcess(tmp_path_factory.mktemp("demo"), "demo", "--out", "out")
    assert process.wait(110) == 0, process.stdout + process.stderr
    return process


@pytest.fixture(scope="module")
def recording(demo):
    return whole(demo.directory / "out" / "demo.mcap")


def figure(text, pattern):
    match = re.search(pattern, text)
    assert match, f"{pattern!r} is not in:\n{text}"
    return int(match[1])


def test_demo__figures__nothing_lost_and_every_bound_met(demo, recording):
    text = demo.stdout
    cycles = figure(text, r"cycles +(\d+) run")
    published = figure(text, r"(\d+) samples published")
    received = figure(text, r"; (\d+) *received by another process")
    assert figure(text, r"another process, (\d+) lost") == 0
    assert figure(text, r"(\d+) not sent") == 0
    assert cycles == len(recording.samples)
    assert 20_000 <= received <= published <= cycles
    sent, got = figure(text, r"bus +(\d+) frames sent"), figure(text, r"sent, (\d+) received")
    assert sent >= 3 * cycles  # SYNC and two commands each
    assert got >= 2 * cycles
    verdict = [line for line in text.splitlines() if line.rstrip().endswith(("PASS", "FAIL"))]
    assert len(verdict) >= len(SCENARIOS["A"].bounds)
    assert all(line.rstrip().endswith("PASS") for line in verdict)
    for word in ("lateness", "busy", "rms", "peak", "Kd"):
        assert word in text


def test_demo__progress__is_shown_and_nothing_else_on_stderr(demo):
    assert "tracking" in demo.stderr
    assert "hil:" not in demo.stderr


def test_demo__recording__opens_with_the_mcap_reader_and_is_plain_protobuf(demo, recording):
    counts = {}
    with (demo.directory / "out" / "demo.mcap").open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert {schema.name for schema in summary.schemas.values()} == {
            "hil.v1.Sample", "hil.v1.BusLog", "hil.v1.Event",
        }  # fmt: skip
        for schema, channel, message in reader.iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
            assert schema.encoding == channel.message_encoding == "protobuf"
            if channel.topic == "telemetry" and counts["telemetry"] == 10_000:
                sample = telemetry_pb2.Sample.FromString(message.data)
                assert sample.seq == 9_999
                assert len(sample.q_meas_rad) == 2
    assert counts["telemetry"] == len(recording.samples)
    assert counts["event"] == len(recording.events)
    assert summary.statistics.message_count == sum(counts.values())


def test_demo__recording__shows_the_whole_run(recording):
    samples = recording.samples
    changes = [e.detail["to"] for e in recording.events if e.kind == "state"]
    assert changes == ["IDLE", "READY", "ACTIVE", "HOLD", "STOPPING", "IDLE"]
    visited = list(dict.fromkeys(State(int(s)).name for s in samples["state"]))
    assert visited[:4] == ["IDLE", "READY", "ACTIVE", "HOLD"]  # at rest, STOPPING takes no cycle
    assert samples["state"][-1] == State.IDLE
    active = samples[samples["state"] == State.ACTIVE]
    assert 20.0 <= active["t_ref_s"][-1] < 20.5  # the braking at its end included
    assert not samples["fault"].any()


def test_demo__report__has_pages_and_pictures_that_are_not_blank(demo):
    out = demo.directory / "out"
    pages = [path for path in out.iterdir() if path.suffix in {".html", ".md"}]
    assert pages
    pictures = sorted(out.rglob("*.png"))
    assert len(pictures) >= 5
    for path in pictures:
        pixels = imread(path)[..., :3]
        assert min(pixels.shape[:2]) > 200
        ink = np.any(np.abs(pixels - pixels[0, 0]) > 0.1, axis=-1)
        assert ink.mean() > 0.005
        assert ink.any(axis=0).mean() > 0.5  # spread over the picture
