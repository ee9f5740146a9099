"""Our MCAP writer against the library's: the same bytes for the same calls."""

import io

from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import Writer

from hil import mcap_writer
from hil.mcap_writer import McapWriter

TIMES = st.integers(0, 2**63)
STEPS = st.lists(
    st.one_of(
        st.tuples(
            st.just("message"), st.integers(1, 2), TIMES, st.binary(max_size=400),
            st.integers(0, 2**32 - 1),
        ),
        st.tuples(st.just("attachment"), TIMES, st.text(max_size=5), st.binary(max_size=20)),
        st.tuples(st.just("metadata"), st.dictionaries(st.text(max_size=3), st.text(max_size=3))),
        st.tuples(st.just("flush")),
    ),
    max_size=60,
)  # fmt: skip


def set_up(writer):
    writer.start(library="hil")
    schema = writer.register_schema("hil.v1.Sample", "protobuf", b"schema")
    for topic in ("telemetry", "bus"):
        writer.register_channel(topic, "protobuf", schema)


def written_by_library(steps, chunk_size):
    file = io.BytesIO()
    writer = Writer(file, chunk_size=chunk_size)
    set_up(writer)
    for kind, *rest in steps:
        match kind:
            case "message":
                channel, t_ns, data, sequence = rest
                writer.add_message(channel, t_ns, data, t_ns, sequence)
            case "attachment":
                writer.add_attachment(rest[0], rest[0], rest[1], "x/y", rest[2])
            case "metadata":
                writer.add_metadata("m", rest[0])
            case "flush":
                writer.flush()
    writer.finish()
    return file.getvalue()


def written_by_ours(steps):
    file = io.BytesIO()
    writer = McapWriter(file)
    set_up(writer)
    for kind, *rest in steps:
        match kind:
            case "message":
                writer.add_message(*rest)
            case "attachment":
                writer.add_attachment(rest[0], rest[1], "x/y", rest[2])
            case "metadata":
                writer.add_metadata("m", rest[0])
            case "flush":
                writer.flush()
    writer.finish()
    return file.getvalue()


@settings(max_examples=150)
@given(steps=STEPS)
def test_writer__any_calls__same_bytes_as_the_library(steps):
    assert written_by_ours(steps) == written_by_library(steps, mcap_writer.CHUNK_SIZE)


def test_writer__more_than_a_chunk__closed_where_the_library_closes_it(monkeypatch):
    monkeypatch.setattr(mcap_writer, "CHUNK_SIZE", 10_000)
    steps = [("message", 1 + k % 2, k, bytes(997), k) for k in range(64)]
    ours = written_by_ours(steps)
    assert ours == written_by_library(steps, 10_000)
    assert make_reader(io.BytesIO(ours)).get_summary().statistics.chunk_count == 7
