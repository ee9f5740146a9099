"""Recordings as tables for other tools."""

import csv
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final, TextIO

import numpy as np

from controller.machine import State
from hil.fixed_protobuf import Records
from hil.recording import Recording

_JOINT_COLUMNS: Final = {  # field of `hil.v1.Sample` -> column
    "q_meas_rad": "q_meas_{}_rad",
    "dq_meas_rad_s": "dq_meas_{}_rad_s",
    "q_des_rad": "q_des_{}_rad",
    "dq_des_rad_s": "dq_des_{}_rad_s",
    "S_rad_s": "S_{}_rad_s",
    "sigma": "sigma_{}",
    "Kd": "Kd_{}",
    "tau_cmd_Nm": "tau_cmd_{}_Nm",
    "tau_sent_Nm": "tau_sent_{}_Nm",
}
_TRUTH_COLUMNS: Final = {
    "q_true_rad": "q_true_{}_rad",
    "dq_true_rad_s": "dq_true_{}_rad_s",
    "tau_applied_Nm": "tau_applied_{}_Nm",
}
_STAMPS: Final = ("wake_late_ns", "feedback_ns", "law_ns", "sent_ns", "busy_ns")
_MONITORS: Final = ("V_rad2_s2", "dissipation_W", "demand_W", "is_dissipating")
_MONITOR_COLUMNS: Final = {
    "in_Omega_Kd": "in_Omega_Kd_{}",
    "Omega_Kd_entries": "Omega_Kd_entries_{}",
    "Omega_Kd_exits": "Omega_Kd_exits_{}",
    "tau_need_Nm": "tau_need_{}_Nm",
    "S_bound_rad_s": "S_bound_{}_rad_s",
}
_BLOCK: Final = 10_000  # rows turned into text at a time
_STATE_NAMES: Final = {state.value: state.name for state in State}


def export_csv(recording: Recording, stream: TextIO) -> None:
    """Write one row per cycle; the same recording always gives the same text.

    Columns: `t_s` (since the first sample), `cycle`, `state` (by name), then per joint j from 1
    the fields of `hil.v1.Sample` named `FIELD_j_UNIT`, from simulation also the plant's truth,
    then the stamps of the cycle in ns after its scheduled start, then the monitors: those of the
    arm, and per joint those of the joint. Floats are written so that reading them back gives the
    same value.

    Args:
        recording: May hold no samples; the header is written all the same.
        stream: Opened for text with `newline=""`, or standard output.
    """
    rows = recording.samples
    writer = csv.writer(stream, lineterminator="\n")
    names = {**_JOINT_COLUMNS, **(_TRUTH_COLUMNS if recording.has_truth else {})}
    joints = range(recording.joints)
    titles, monitors = _titles(names, joints), _titles(_MONITOR_COLUMNS, joints)
    writer.writerow(("t_s", "cycle", "state", *titles, *_STAMPS, *_MONITORS, *monitors))
    for start in range(0, len(rows), _BLOCK):
        block = rows[start : start + _BLOCK]
        t_s = (block["t_ns"] - rows["t_ns"][0]) / 1e9
        writer.writerows(zip(*_columns(block, t_s.tolist(), tuple(names), joints), strict=True))


def _titles(names: Mapping[str, str], joints: Sequence[int]) -> list[str]:
    return [title.format(joint + 1) for joint in joints for title in names.values()]


def _columns(
    rows: Records, t_s: Sequence[float], fields: Sequence[str], joints: Sequence[int]
) -> Iterator[Sequence[Any]]:
    yield t_s
    yield rows["cycle"].tolist()
    yield [_STATE_NAMES.get(state, state) for state in rows["state"].tolist()]
    yield from _joint_columns(rows, fields, joints)
    for name in (*_STAMPS, *_MONITORS):
        yield rows[name].tolist()
    yield from _joint_columns(rows, tuple(_MONITOR_COLUMNS), joints)


def _joint_columns(
    rows: Records, fields: Sequence[str], joints: Sequence[int]
) -> Iterator[Sequence[Any]]:
    for joint in joints:
        for field in fields:
            yield np.ascontiguousarray(rows[field][:, joint]).tolist()
