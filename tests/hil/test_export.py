import csv
import io

import numpy as np
import pytest

from hil.export import export_csv
from hil.recording import Recording, RecordingWriter
from hil.telemetry import SampleLayout
from tests.hil.closed_loop import payloads, run_named

JOINT_COLUMNS = [
    "q_meas_{}_rad",
    "dq_meas_{}_rad_s",
    "q_des_{}_rad",
    "dq_des_{}_rad_s",
    "S_{}_rad_s",
    "sigma_{}",
    "Kd_{}",
    "tau_cmd_{}_Nm",
    "tau_sent_{}_Nm",
]
TRUTH_COLUMNS = ["q_true_{}_rad", "dq_true_{}_rad_s", "tau_applied_{}_Nm"]
STAMPS = ["wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns"]
MONITORS = ["V_rad2_s2", "dissipation_W", "demand_W", "is_dissipating"]
MONITOR_COLUMNS = [
    "in_Omega_Kd_{}",
    "Omega_Kd_entries_{}",
    "Omega_Kd_exits_{}",
    "tau_need_{}_Nm",
    "S_bound_{}_rad_s",
]


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    path = tmp_path_factory.mktemp("export") / "a.mcap"
    rows = run_named("A")[:3000].copy()
    rows["t_ns"] += 7_000_000_000
    with RecordingWriter(path, {}, joints=2, with_truth=True) as writer:
        for k, payload in enumerate(payloads(rows)):
            writer.add_sample(int(rows["t_ns"][k]), k, payload)
    return Recording.open(path)


def exported(recording: Recording) -> str:
    stream = io.StringIO(newline="")
    export_csv(recording, stream)
    return stream.getvalue()


def columns_of(joints, per_joint):
    return [name.format(j) for j in range(1, joints + 1) for name in per_joint]


def empty(tmp_path, joints, with_truth) -> Recording:
    path = tmp_path / "empty.mcap"
    RecordingWriter(path, {}, joints, with_truth).close()
    return Recording.open(path)


def test_export_csv__simulated_run__columns_of_the_design_with_truth(recording):
    header = exported(recording).split("\n", 1)[0].split(",")
    per_joint = columns_of(2, JOINT_COLUMNS + TRUTH_COLUMNS)
    documented = ["t_s", "cycle", "state", *per_joint, *STAMPS]
    assert header[: len(documented)] == documented
    assert header[len(documented) :] == [*MONITORS, *columns_of(2, MONITOR_COLUMNS)]


def test_export_csv__hardware_without_samples__header_alone(tmp_path):
    text = exported(empty(tmp_path, 6, with_truth=False))
    documented = ("t_s", "cycle", "state", *columns_of(6, JOINT_COLUMNS), *STAMPS)
    assert text == ",".join((*documented, *MONITORS, *columns_of(6, MONITOR_COLUMNS))) + "\n"


def test_export_csv__every_value__reads_back_bit_for_bit(recording):
    rows = list(csv.DictReader(io.StringIO(exported(recording))))
    assert len(rows) == 3000
    for name, field, joint in (
        ("q_meas_2_rad", "q_meas_rad", 1),
        ("tau_applied_1_Nm", "tau_applied_Nm", 0),
        ("Kd_1", "Kd", 0),
        ("tau_need_2_Nm", "tau_need_Nm", 1),
    ):
        values = np.array([float(row[name]) for row in rows])
        assert values.tobytes() == recording.samples[field][:, joint].tobytes()
    assert [int(row["busy_ns"]) for row in rows] == recording.samples["busy_ns"].tolist()
    is_dissipating = recording.samples["is_dissipating"].tolist()
    assert [int(row["is_dissipating"]) for row in rows] == is_dissipating


def test_export_csv__clock_that_started_long_ago__time_counts_from_the_first_sample(recording):
    rows = list(csv.DictReader(io.StringIO(exported(recording))))
    assert [rows[k]["t_s"] for k in (0, 1, 2999)] == ["0.0", "0.001", "2.999"]
    assert {row["state"] for row in rows} == {"ACTIVE"}


def test_export_csv__same_recording_twice__same_text(recording):
    assert exported(recording) == exported(Recording.open(recording.path))


def test_export_csv__unknown_state__its_number(tmp_path):
    layout, path = SampleLayout(1, with_truth=False), tmp_path / "run.mcap"
    buffer = bytearray(layout.size)
    scalars = [1, 1, 1, 99, *[0] * (len(layout.scalar_names) - 4)]
    layout.writer()(buffer, 0, scalars, [[float("nan")] for _ in layout.list_names])
    with RecordingWriter(path, {}, joints=1, with_truth=False) as writer:
        writer.add_sample(1, 1, bytes(buffer))
    row = exported(Recording.open(path)).splitlines()[1].split(",")
    assert row[:4] == ["0.0", "1", "99", "nan"]
