"""Samples: written as one struct against protobuf's own serialiser, and their way into MCAP."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mcap.writer import Writer

from benchmarks import rig
from benchmarks.measure import (
    Samples,
    Target,
    alternate,
    median,
    percentile,
    ratio,
    row,
    times,
    title,
    us,
)
from hil.mcap_writer import McapWriter
from hil.proto import telemetry_pb2
from hil.recording import RecordingWriter
from hil.simulation import open_recording
from hil.telemetry import SampleLayout

TURNS, CALLS = 40, 200
BATCH = 50
Values = tuple[tuple[float, ...], list[list[float]]]


def run(scale: float) -> list[Target]:
    title("recording", "one sample of 2 joints with the plant's truth, against protobuf's own")
    row("", "ours p50", "ours p99", "protobuf p50", "protobuf p99", "pb/ours")
    layout = SampleLayout(2, with_truth=True)
    values = _values(layout)
    _require_equal(layout, values)
    turns = round(TURNS * scale) + 2
    written = alternate(_writers(layout, values), turns=turns, calls=CALLS)
    _print("serialise one sample", written)
    _print(
        "read one sample of a batch",
        _per_sample(alternate(_readers(layout, values), turns=turns, calls=4)),
    )
    with (
        rig.scratch_file("ours.mcap") as ours,
        rig.scratch_file("plain.mcap") as plain,
        open_recording(rig.configuration(), ours) as recording,
        open_recording(rig.configuration(), plain) as other,
    ):
        bodies = _recorders(layout, values, recording, other)
        _print("serialise and write into MCAP", alternate(bodies, turns=turns, calls=CALLS))
    row("", "ours p50", "ours p99", "mcap p50", "mcap p99", "mcap/ours")
    with rig.scratch_file("ours.mcap") as ours, rig.scratch_file("plain.mcap") as plain:
        files = _files(ours, plain, _sample(layout, values))
        _print("write one message", _per_sample(alternate(files, turns=turns, calls=4)))
    return []


def _print(label: str, samples: Samples) -> None:
    cells = []
    for name in ("ours", "pb"):
        cells += [us(median(samples[name])), us(percentile(samples[name], 0.99))]
    row(label, *cells, times(ratio(samples, "pb", "ours")))


def _files(ours: Path, plain: Path, payload: bytes) -> dict[str, Callable[[], object]]:
    """Write a batch of messages and flush it, with our writer and with the library's own."""
    mine, theirs = McapWriter(ours.open("wb")), Writer(str(plain))
    for writer in (mine, theirs):
        writer.start(library="hil")
        schema = writer.register_schema("hil.v1.Sample", "protobuf", b"")
        writer.register_channel("telemetry", "protobuf", schema)

    def write_ours() -> None:
        for seq in range(BATCH):
            mine.add_message(1, seq, payload, seq)
        mine.flush()

    def write_theirs() -> None:
        for seq in range(BATCH):
            theirs.add_message(1, seq, payload, seq, seq)
        theirs.flush()

    return {"ours": write_ours, "pb": write_theirs}


def _per_sample(samples: Samples) -> Samples:
    return {name: [value / BATCH for value in values] for name, values in samples.items()}


def _values(layout: SampleLayout) -> Values:
    scalars = tuple(range(len(layout.scalar_names)))
    lists = [[0.1 + i, -0.2 - i] for i in range(len(layout.list_names))]
    return scalars, lists


def _require_equal(layout: SampleLayout, values: Values) -> None:
    """Check that both writers' samples parse to the same message."""
    buffer = bytearray(layout.size)
    layout.writer()(buffer, 0, *values)
    ours, theirs = telemetry_pb2.Sample(), telemetry_pb2.Sample()
    ours.ParseFromString(bytes(buffer))
    theirs.ParseFromString(_serialise(layout, *values))
    if ours != theirs:
        raise RuntimeError("the two writers do not write the same sample")


def _serialise(
    layout: SampleLayout, scalars: Sequence[float], lists: Sequence[Sequence[float]]
) -> bytes:
    """Build a message and serialise it, the way generated code is used."""
    fields: dict[str, Any] = dict(zip(layout.scalar_names, scalars, strict=True))
    fields.update(zip(layout.list_names, lists, strict=True))
    return telemetry_pb2.Sample(**fields).SerializeToString()


def _writers(layout: SampleLayout, values: Values) -> dict[str, Callable[[], object]]:
    write, buffer = layout.writer(), bytearray(layout.size)
    return {
        "ours": lambda: write(buffer, 0, *values),
        "pb": lambda: _serialise(layout, *values),
    }


def _readers(layout: SampleLayout, values: Values) -> dict[str, Callable[[], object]]:
    """Read a batch into columns; the reference takes one column of each of three fields."""
    batch = layout.batch([_sample(layout, values)] * BATCH)

    def parse() -> object:
        message = telemetry_pb2.SampleBatch.FromString(batch)
        return [(s.t_ns, list(s.q_meas_rad), list(s.tau_sent_Nm)) for s in message.samples]

    def view() -> object:
        rows = layout.decode_batch(batch)
        return rows["t_ns"].tolist(), rows["q_meas_rad"].tolist(), rows["tau_sent_Nm"].tolist()

    return {"ours": view, "pb": parse}


def _sample(layout: SampleLayout, values: Values) -> bytes:
    buffer = bytearray(layout.size)
    layout.writer()(buffer, 0, *values)
    return bytes(buffer)


def _recorders(
    layout: SampleLayout, values: Values, recording: RecordingWriter, other: RecordingWriter
) -> dict[str, Callable[[], object]]:
    """Both go through the recording's own writer; only the serialiser differs."""
    write, buffer = layout.writer(), bytearray(layout.size)
    seq = {"ours": 0, "pb": 0}

    def ours() -> None:
        seq["ours"] += 1
        write(buffer, 0, *values)
        recording.add_sample(seq["ours"] * 1_000_000, seq["ours"], bytes(buffer))

    def pb() -> None:
        seq["pb"] += 1
        other.add_sample(seq["pb"] * 1_000_000, seq["pb"], _serialise(layout, *values))

    return {"ours": ours, "pb": pb}
