import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from hil.errors import HilError
from hil.proto import telemetry_pb2
from hil.recording import Recording, RecordingError, RecordingWriter
from hil.telemetry import RECEIVED, SENT, BusFrameLayout, LoggedFrame, SampleLayout

ROOT = Path(__file__).parents[2]
CONFIG = {"scenario": "A", "arm": {"name": "bench"}}
LAYOUT = SampleLayout(2, with_truth=True)
FRAMES = [
    LoggedFrame(1_000, SENT, bytes(range(16))),
    LoggedFrame(2_000, RECEIVED, bytes(range(16, 32))),
]


def sample(k: int, layout: SampleLayout = LAYOUT) -> bytes:
    buffer = bytearray(layout.size)
    scalars = [k, k, k * 1_000_000, *[0] * (len(layout.scalar_names) - 3)]
    layout.writer()(buffer, 0, scalars, [[k + 0.25, -k - 0.5] for _ in layout.list_names])
    return bytes(buffer)


def bus_log(frames) -> bytes:
    return b"".join(BusFrameLayout().entry(*frame) for frame in frames)


def record(path: Path, count: int = 250) -> Path:
    with RecordingWriter(path, CONFIG, joints=2, with_truth=True) as writer:
        writer.add_event(0, 0, "state", {"to": "READY", "from": "IDLE"})
        for k in range(count):
            writer.add_sample(k * 1_000_000, k, sample(k))
            if k % 10 == 0:
                writer.add_bus_log(k * 1_000_000, bus_log(FRAMES))
    return path


def test_open__complete_recording__everything_comes_back(tmp_path):
    recording = Recording.open(record(tmp_path / "run.mcap"))
    assert recording.config == CONFIG
    assert (recording.joints, recording.has_truth, recording.is_truncated) == (2, True, False)
    assert recording.samples["seq"].tolist() == list(range(250))
    assert recording.samples["q_meas_rad"][:, 1].tolist() == [-k - 0.5 for k in range(250)]
    assert recording.samples["tau_applied_Nm"][7].tolist() == [7.25, -7.5]
    event = recording.events[0]
    assert (event.kind, event.detail) == ("state", {"from": "IDLE", "to": "READY"})
    assert list(recording.frames()) == FRAMES * 25


def test_writer__complete_recording__mcap_reader_and_its_schema_decode_it(tmp_path):
    with record(tmp_path / "run.mcap").open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        messages = list(reader.iter_messages(topics="telemetry"))
        assert [m.name for m in reader.iter_metadata()] == ["config"]
    assert {c.topic: c.message_encoding for c in summary.channels.values()} == dict.fromkeys(
        ("telemetry", "bus", "event"), "protobuf"
    )
    schema, _, message = messages[42]
    files = descriptor_pb2.FileDescriptorSet.FromString(schema.data)
    pool = descriptor_pool.DescriptorPool()
    for file in files.file:
        pool.Add(file)
    decode = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
    assert schema.name == "hil.v1.Sample"
    assert list(decode.FromString(message.data).q_des_rad) == [42.25, -42.5]
    assert (message.log_time, message.sequence) == (42_000_000, 42)


def test_writer__same_input_twice__same_bytes(tmp_path):
    first, second = record(tmp_path / "a.mcap"), record(tmp_path / "b.mcap")
    assert first.read_bytes() == second.read_bytes()


def test_writer__other_process_and_hash_seed__same_bytes(tmp_path):
    code = (
        "import sys; from pathlib import Path; from tests.hil.test_recording import record;"
        " record(Path(sys.argv[1]))"
    )
    subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "b.mcap")],
        check=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONHASHSEED": "12345", "TZ": "Asia/Tokyo"},
    )
    assert record(tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_writer__killed__all_but_the_last_tenth_of_a_second_is_there(tmp_path):
    path = tmp_path / "run.mcap"
    code = """
import sys
from pathlib import Path
from tests.hil.test_recording import CONFIG, RecordingWriter, sample
writer = RecordingWriter(Path(sys.argv[1]), CONFIG, joints=2, with_truth=True)
for k in range(1234):
    writer.add_sample(k * 1_000_000, k, sample(k))
print("written", flush=True)
sys.stdin.read()
"""
    command = [sys.executable, "-c", code, str(path)]
    with subprocess.Popen(
        command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"written\n"
        process.send_signal(signal.SIGKILL)
    recording = Recording.open(path)
    assert recording.is_truncated
    assert recording.config == CONFIG
    assert 1234 - 100 <= len(recording.samples) <= 1234
    assert (np.diff(recording.samples["seq"]) == 1).all()


def test_open__killed_before_the_first_sample__configuration_and_no_samples(tmp_path):
    writer = RecordingWriter(tmp_path / "run.mcap", CONFIG, joints=3, with_truth=False)
    recording = Recording.open(tmp_path / "run.mcap")
    writer.close()
    assert (recording.config, recording.is_truncated) == (CONFIG, True)
    assert recording.samples["Kd"].shape == (0, 3)


def test_flush__recording_still_open__samples_are_readable(tmp_path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, CONFIG, joints=2, with_truth=True) as writer:
        for k in range(50):
            writer.add_sample(k * 1_000_000, k, sample(k))
        writer.flush()
        assert len(Recording.open(path).samples) == 50


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("whole") / "run.mcap")


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(share=st.floats(0, 1))
def test_open__cut_anywhere__prefix_of_the_samples_or_recording_error(whole, tmp_path, share):
    path = tmp_path / "cut.mcap"
    content = whole.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with suppress(RecordingError):
        recording = Recording.open(path)
        count = len(recording.samples)
        assert recording.samples["seq"].tolist() == list(range(count))
        assert recording.is_truncated == (path.stat().st_size < len(content))
        frames = list(recording.frames())
        assert frames == (FRAMES * 25)[: len(frames)]


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=100)
@given(share=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_open__byte_changed__undamaged_samples_or_recording_error(whole, tmp_path, share, flip):
    damaged = bytearray(whole.read_bytes())
    damaged[int(share * len(damaged))] ^= flip
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damaged)
    with suppress(RecordingError):
        recording = Recording.open(path)
        if recording.samples.dtype == LAYOUT.dtype:
            seq = recording.samples["seq"].tolist()
            assert seq == list(range(len(seq)))
        for frame in recording.frames():
            assert frame in FRAMES


@pytest.mark.parametrize("content", [b"", b"\x89MCAP", b"time,q\n0.0,0.1\n", bytes(4096)])
def test_open__not_mcap__one_clear_line(tmp_path, content):
    path = tmp_path / "run.csv"
    path.write_bytes(content)
    with pytest.raises(HilError, match=r"run\.csv is not an MCAP recording$"):
        Recording.open(path)


def test_open__mcap_of_another_program__refused(tmp_path):
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        writer.finish()
    with pytest.raises(RecordingError, match="not a recording of this program"):
        Recording.open(path)


@pytest.mark.parametrize(("name", "reason"), [("none.mcap", "No such file"), (".", "directory")])
def test_open__no_such_file__reason_is_said(tmp_path, name, reason):
    with pytest.raises(RecordingError, match=f"cannot open recording.*{reason}"):
        Recording.open(tmp_path / name)


def test_writer__directory_missing__reason_is_said(tmp_path):
    with pytest.raises(RecordingError, match=r"cannot create recording.*No such file"):
        RecordingWriter(tmp_path / "none" / "run.mcap", CONFIG, joints=2, with_truth=True)


def test_writer__disk_full__recording_error():
    with pytest.raises(RecordingError, match="cannot write recording /dev/full: No space left"):
        RecordingWriter(Path("/dev/full"), CONFIG, joints=2, with_truth=True)


def test_open__samples_of_another_protobuf_writer__read(tmp_path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, "{}", joints=2, with_truth=True) as writer:
        writer.add_sample(0, 0, sample(0))
        shorter = telemetry_pb2.Sample.FromString(sample(0)).SerializeToString()
        assert len(shorter) < LAYOUT.size
        writer.add_sample(0, 0, shorter)
    rows = Recording.open(path).samples
    assert rows[0].tobytes() != b""
    assert rows["sigma"].tolist() == [[0.25, -0.5]] * 2


def test_open__sample_that_is_none__recording_error(tmp_path):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, "{}", joints=2, with_truth=True) as writer:
        writer.add_sample(0, 0, b"\xff\xff")
    with pytest.raises(RecordingError, match=r"run\.mcap"):
        Recording.open(path)


@pytest.mark.parametrize(
    ("text", "detail"),
    [('{"a": 1}', {"a": 1}), ("plain", {"text": "plain"}), ("[1]", {"text": [1]})],
)
def test_events__detail_of_any_text__is_a_dictionary(tmp_path, text, detail):
    path = tmp_path / "run.mcap"
    with RecordingWriter(path, json.dumps(CONFIG), joints=1, with_truth=False) as writer:
        writer.add_event(5, 2, "fault", text)
    event = Recording.open(path).events[0]
    assert (event.t_ns, event.cycle, event.kind, event.detail) == (5, 2, "fault", detail)
