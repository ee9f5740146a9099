import math
import struct
from contextlib import suppress
from itertools import cycle, islice

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from google.protobuf.unknown_fields import UnknownFieldSet
from hypothesis import given
from hypothesis import strategies as st

from hil.proto import telemetry_pb2
from hil.telemetry import (
    RECEIVED,
    SENT,
    BusFrameLayout,
    LoggedFrame,
    SampleLayout,
    TelemetryError,
)

RANGES = {
    **dict.fromkeys(("seq", "cycle"), (0, 2**64 - 1)),
    "t_ns": (-(2**63), 2**63 - 1),
    **dict.fromkeys(
        ("state", "fault", "feedback_age_cycles", "overruns", "is_dissipating"), (0, 2**32 - 1)
    ),
    **dict.fromkeys(
        ("wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns"), (-(2**31), 2**31 - 1)
    ),
}


@st.composite
def samples(draw, least_scalar=None):
    layout = SampleLayout(draw(st.sampled_from([1, 2, 3, 16])), with_truth=draw(st.booleans()))
    scalars = []
    for name in layout.scalar_names:
        if name in RANGES:
            low, high = RANGES[name]
            scalars.append(draw(st.integers(low if least_scalar is None else least_scalar, high)))
        else:
            scalars.append(draw(st.floats(min_value=least_scalar)))
    pool = cycle(draw(st.lists(st.floats(), min_size=1, max_size=7)))
    return layout, scalars, [list(islice(pool, layout.joints)) for _ in layout.list_names]


def write(layout, scalars, lists) -> bytes:
    buffer = bytearray(layout.size)
    layout.writer()(buffer, 0, scalars, lists)
    return bytes(buffer)


def generated(layout, scalars, lists) -> telemetry_pb2.Sample:
    values = zip(layout.scalar_names, scalars, strict=True)
    return telemetry_pb2.Sample(**dict(values), **dict(zip(layout.list_names, lists, strict=True)))


def bits(values) -> list[bytes]:
    return [struct.pack("<d", value) for value in values]


@given(samples())
def test_writer__any_values__generated_class_reads_them_bit_for_bit(sample):
    layout, scalars, lists = sample
    message = telemetry_pb2.Sample.FromString(write(layout, scalars, lists))
    for name, value in zip(layout.scalar_names, scalars, strict=True):
        read = getattr(message, name)
        assert read == value if name in RANGES else bits([read]) == bits([value])
    for name, entries in zip(layout.list_names, lists, strict=True):
        assert bits(getattr(message, name)) == bits(entries)
    assert len(UnknownFieldSet(message)) == 0


@given(samples(least_scalar=1))
def test_writer__no_zero_scalar__same_bytes_as_generated_class(sample):
    assert write(*sample) == generated(*sample).SerializeToString(deterministic=True)


@given(samples(), samples())
def test_writer__same_layout__constant_size(first, second):
    layout, _, _ = first
    assert len(write(*first)) == layout.size
    if (layout.joints, layout.with_truth) == (second[0].joints, second[0].with_truth):
        assert second[0].size == layout.size


@pytest.mark.parametrize("with_truth", [True, False])
@pytest.mark.parametrize("joints", [1, 2, 6, 12, 16, 200])
def test_layout__number_of_joints__fields_are_those_of_the_contract(joints, with_truth):
    layout = SampleLayout(joints, with_truth)
    fields = telemetry_pb2.Sample.DESCRIPTOR.fields
    expected = [f.name for f in fields if with_truth or f.number < 40]
    assert [*layout.scalar_names, *layout.list_names] == expected
    assert list(layout.dtype.names) == expected
    assert layout.dtype.itemsize == layout.size
    assert layout.dtype["q_meas_rad"].shape == (joints,)


def test_layout__no_joints__refused():
    with pytest.raises(ValueError, match="at least one joint"):
        SampleLayout(0, with_truth=False)


def test_writer__offset__writes_only_its_slot():
    layout = SampleLayout(2, with_truth=False)
    buffer = bytearray(b"\xaa" * (3 * layout.size))
    lists = [[1.0, 2.0] for _ in layout.list_names]
    layout.writer()(memoryview(buffer), layout.size, range(1, len(layout.scalar_names) + 1), lists)
    assert buffer[: layout.size] == buffer[2 * layout.size :] == b"\xaa" * layout.size
    assert telemetry_pb2.Sample.FromString(buffer[layout.size : 2 * layout.size]).busy_ns == 12


@pytest.mark.parametrize("change", ["list missing", "list too long", "lists too short", "scalar"])
def test_writer__wrong_shape__refused_and_buffer_untouched(change):
    layout = SampleLayout(2, with_truth=False)
    scalars, lists = [0] * len(layout.scalar_names), [[0.0, 0.0] for _ in layout.list_names]
    if change == "list missing":
        lists.pop()
    elif change == "list too long":
        lists[3].append(0.0)
    elif change == "lists too short":
        lists = [[0.0] for _ in layout.list_names]
    else:
        scalars.pop()
    buffer = bytearray(layout.size)
    with pytest.raises(ValueError, match=r"zip|slice"):
        layout.writer()(buffer, 0, scalars, lists)
    assert buffer == bytes(layout.size)


def test_writer__lateness_beyond_its_field__written_as_the_largest():
    layout = SampleLayout(1, with_truth=False)
    scalars = [0] * len(layout.scalar_names)
    scalars[layout.scalar_names.index("wake_late_ns")] = 5_000_000_000
    scalars[layout.scalar_names.index("busy_ns")] = -5_000_000_000
    scalars[layout.scalar_names.index("t_ref_s")] = 1e300
    write_sample, buffer = layout.writer(), bytearray(layout.size)
    lists = [[1.5] for _ in layout.list_names]
    write_sample(buffer, 0, scalars, lists)
    message = telemetry_pb2.Sample.FromString(buffer)
    assert (message.wake_late_ns, message.busy_ns) == (2**31 - 1, -(2**31))
    assert (message.t_ref_s, list(message.sigma)) == (1e300, [1.5])
    write_sample(buffer, 0, [7] * len(scalars), lists)
    assert telemetry_pb2.Sample.FromString(buffer).busy_ns == 7


@given(samples())
def test_decode_batch__own_batch__same_values_without_parsing(sample):
    layout, scalars, lists = sample
    payload = write(layout, scalars, lists)
    rows = layout.decode_batch(layout.batch([payload, memoryview(payload), payload]))
    assert rows.dtype == layout.dtype
    assert len(rows) == 3
    assert rows[2].tobytes() == payload


@given(samples())
def test_decode_batch__batch_of_the_generated_class__same_values(sample):
    layout, scalars, lists = sample
    message = generated(layout, scalars, lists)
    batch = telemetry_pb2.SampleBatch(samples=[message, message]).SerializeToString()
    rows = layout.decode_batch(batch)
    assert len(rows) == 2
    for name, value in zip(layout.scalar_names, scalars, strict=True):
        assert rows[name][1].tobytes() == np.array(value, layout.dtype[name]).tobytes()
    for name, entries in zip(layout.list_names, lists, strict=True):
        assert bits(rows[name][1]) == bits(entries)


def test_batch__samples_of_a_layout__generated_class_reads_it():
    layout = SampleLayout(2, with_truth=True)
    lists = [[1.0, -2.0] for _ in layout.list_names]
    batch = layout.batch([write(layout, [k] * len(layout.scalar_names), lists) for k in range(5)])
    message = telemetry_pb2.SampleBatch.FromString(batch)
    assert [s.seq for s in message.samples] == [0, 1, 2, 3, 4]
    assert list(message.samples[4].tau_applied_Nm) == [1.0, -2.0]


def test_batch__sample_of_another_layout__refused():
    layout = SampleLayout(2, with_truth=True)
    with pytest.raises(ValueError, match="bytes"):
        layout.batch([bytes(layout.size - 1)])


def test_decode__samples_of_mixed_size__all_read():
    layout = SampleLayout(1, with_truth=False)
    own = write(layout, [3] * len(layout.scalar_names), [[1.0] for _ in layout.list_names])
    other = telemetry_pb2.Sample.FromString(own)
    other.seq = 0
    rows = layout.decode([own, other.SerializeToString()])
    assert rows["seq"].tolist() == [3, 0]
    assert rows["tau_meas_Nm"].tolist() == [[1.0], [1.0]]


def test_decode_batch__nothing__no_rows():
    layout = SampleLayout(2, with_truth=False)
    assert layout.decode_batch(b"").shape == (0,)
    assert layout.decode([]).dtype == layout.dtype


def test_decode_batch__sample_without_truth__truth_is_nan():
    with_truth, without = SampleLayout(2, with_truth=True), SampleLayout(2, with_truth=False)
    own = write(without, [1] * len(without.scalar_names), [[1.0, 2.0] for _ in without.list_names])
    rows = with_truth.decode_batch(without.batch([own]))
    assert np.isnan(rows["q_true_rad"]).all()
    assert rows["q_meas_rad"].tolist() == [[1.0, 2.0]]


def test_decode_batch__recording_without_monitors__read_with_the_monitors_missing():
    layout = SampleLayout(2, with_truth=False)
    scalars, lists = [1] * len(layout.scalar_names), [[1.0, 2.0] for _ in layout.list_names]
    message = generated(layout, scalars, lists)
    for field in ("V_rad2_s2", "in_Omega_Kd", "Omega_Kd_exits", "tau_need_Nm", "S_bound_rad_s"):
        message.ClearField(field)
    (row,) = layout.decode([message.SerializeToString()])
    assert row["tau_meas_Nm"].tolist() == row["Omega_Kd_entries"].tolist() == [1.0, 2.0]
    assert np.isnan([row["in_Omega_Kd"], row["tau_need_Nm"], row["S_bound_rad_s"]]).all()


def test_decode_batch__other_number_of_joints__refused_with_field_and_numbers():
    three = SampleLayout(3, with_truth=False)
    scalars, lists = [1] * len(three.scalar_names), [[1.0] * 3 for _ in three.list_names]
    payload = three.batch([write(three, scalars, lists)])
    with pytest.raises(TelemetryError, match="q_meas_rad has 3 values, expected 2"):
        SampleLayout(2, with_truth=False).decode_batch(payload)


@given(st.binary(max_size=400))
def test_decode_batch__any_bytes__rows_or_telemetry_error(payload):
    layout = SampleLayout(1, with_truth=False)
    with suppress(TelemetryError):
        assert layout.decode_batch(payload).dtype == layout.dtype


@given(samples(), st.data())
def test_decode_batch__one_byte_changed__read_as_the_generated_class_reads_it(sample, data):
    layout, scalars, lists = sample
    batch = bytearray(layout.batch([write(layout, scalars, lists)]))
    batch[data.draw(st.integers(0, len(batch) - 1))] ^= data.draw(st.integers(1, 255))
    with suppress(TelemetryError, DecodeError):
        rows = layout.decode_batch(bytes(batch))
        read = telemetry_pb2.SampleBatch.FromString(bytes(batch)).samples
        assert rows["busy_ns"].tolist() == [message.busy_ns for message in read]
        for row, message in zip(rows["q_meas_rad"], read, strict=True):
            assert bits(row) == bits(message.q_meas_rad)


@given(samples())
def test_of__own_batch__finds_joints_and_truth(sample):
    layout, scalars, lists = sample
    found = SampleLayout.of(layout.batch([write(layout, scalars, lists)]))
    assert (found.joints, found.with_truth) == (layout.joints, layout.with_truth)


@pytest.mark.parametrize("payload", [b"", b"\xff", telemetry_pb2.SampleBatch().SerializeToString()])
def test_of__no_sample__refused(payload):
    with pytest.raises(TelemetryError):
        SampleLayout.of(payload)


def records(least, most):
    t_ns = st.integers(-(2**63), 2**63 - 1)
    return st.tuples(
        t_ns, st.sampled_from([RECEIVED, SENT]), st.binary(min_size=least, max_size=most)
    )


RECORDS = records(16, 16) | records(72, 72)
"""Of classic and of CAN FD frames."""


@given(st.lists(records(16, 16), max_size=5) | st.lists(RECORDS, max_size=5))
def test_bus_frame_layout__any_frames__generated_class_and_decoder_agree(logged):
    layout = BusFrameLayout()
    entries = [layout.entry(*frame) for frame in logged]
    sizes = {16: layout.size, 72: layout.fd_size}
    assert [len(entry) for entry in entries] == [sizes[len(frame)] for *_, frame in logged]
    log = b"".join(entries)
    message = telemetry_pb2.BusLog.FromString(log)
    assert [(f.t_ns, f.direction, f.frame) for f in message.frames] == logged
    assert layout.decode_log(log) == [LoggedFrame(*frame) for frame in logged]


@given(st.lists(RECORDS, min_size=1, max_size=5))
def test_first_t_ns__log_of_either_size__that_of_the_first_frame(logged):
    layout = BusFrameLayout()
    log = b"".join(layout.entry(*frame) for frame in logged)
    assert layout.first_t_ns(log) == logged[0][0]


@given(st.lists(records(0, 72), max_size=5))
def test_decode_log__log_of_the_generated_class__same_frames(logged):
    log = telemetry_pb2.BusLog()
    for t_ns, direction, frame in logged:
        log.frames.add(t_ns=t_ns, direction=direction, frame=frame)
    expected = [LoggedFrame(*frame) for frame in logged]
    assert BusFrameLayout().decode_log(log.SerializeToString()) == expected


@given(st.binary(max_size=200))
def test_decode_log__any_bytes__frames_or_telemetry_error(payload):
    with suppress(TelemetryError):
        assert all(isinstance(f, LoggedFrame) for f in BusFrameLayout().decode_log(payload))


def test_writer__nan_and_infinities__kept():
    layout = SampleLayout(3, with_truth=False)
    odd = [math.nan, math.inf, -math.inf]
    zeros = [0] * len(layout.scalar_names)
    rows = layout.decode([write(layout, zeros, [odd for _ in layout.list_names])])
    assert bits(rows["Kd"][0]) == bits(odd)
