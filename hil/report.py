"""Reports: figures, plots and verdict of one recording, for people."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from controller.settings import MODEL_BASED
from hil.document import Block, Heading, Image, Paragraph, Table, write_document
from hil.errors import HilError
from hil.fixed_protobuf import Records
from hil.metrics import (
    UNITS,
    Metrics,
    MetricsError,
    check,
    figures_named,
    format_figure,
    measure,
    measure_scenario,
    table_row,
    timing,
    trajectory_rows,
)
from hil.plots import Span, draw_gain_surface, draw_run, draw_timing
from hil.recording import Part, RecordedEvent, Recording
from hil.region_report import manifold_section
from hil.scenarios import SCENARIOS, Scenario
from hil.timing import CAUSE_TEXTS, TIMES, misses_of, spreads_us

_USAGE: Final = {
    "minor_faults": "page faults without disk access, whole run",
    "major_faults": "page faults with disk access, whole run",
    "involuntary_switches": "involuntary context switches, whole run",
    "resident_kB": "most memory resident [kB]",
}
_STEADY_SHARE: Final = 0.6
_MOST_EVENTS: Final = 40
_LIGHT_TORQUE_Nm: Final = 1.0
_AVERAGE_CYCLES: Final = 100
_FACTS: Final = {
    "arm": "arm.name",
    "preset": "arm.preset",
    "law": "controller.law.name",
    "adaptation": "controller.law.adaptation",
    "velocity": "controller.velocity.estimator",
    "alpha": "controller.law.alpha",
    "lambda": "controller.law.lambda_",
    "Ki": "controller.law.Ki",
    "beta (big, medium, small)": "controller.law.beta",
    "membership": "controller.law.membership",
}
_SELF_TUNING_REMARK: Final = (
    "The decay comes from Kd/H, not from the adaptation of beta: frozen, it is as fast. On"
    " tracking, self-tuning does not beat a constant Kd = Kd_max; it needs a fraction of the"
    " initial peak torque and has less torque chatter."
)
_MODEL_REMARK: Final = (
    "This law is given the regressor of the arm: Y_r Theta carries the torque that the motion"
    " needs, and S_q need not. It is as good as its model."
)
_LEVANT_REMARK: Final = (
    "At 12 bits Levant's differentiator costs about four times the error of a 30 Hz filtered"
    " difference; at 16 bits less, and its own chatter stays (docs/paper.md)."
)
_RANGE_REMARK: Final = (
    " the published gains work where the torque needed within |S| < 1 rad/s stays below about"
    " 1 Nm (light or horizontal arms, moderate speed), not on an arm loaded by gravity."
)


class ReportError(HilError):
    """A report could not be written."""


def write_report(recording_path: Path, out_dir: Path) -> Path:
    """Write the report of one file; see `write_report_of`.

    Raises:
        RecordingError: If the recording cannot be read.
        ReportError: As for `write_report_of`.
    """
    return write_report_of(Recording.open(recording_path), out_dir)


def write_report_of(recording: Recording, out_dir: Path) -> Path:
    """Write `report.md`, `report.html` and their plots for a recording.

    The HTML file holds its images; the Markdown file refers to the PNG files beside it. If the
    recording names a reference scenario, its figures are held against the scenario's bounds.

    Args:
        recording: Of a run, or of a part of one.
        out_dir: Created if missing; files of an earlier report are replaced.

    Returns:
        The path of `report.html`.

    Raises:
        ReportError: If it holds no samples, or `out_dir` cannot be written.
    """
    if len(recording.samples) < 2:
        raise ReportError(
            f"{recording.path} holds {len(recording.samples)} samples: nothing to report;"
            " was the loop stopped before its first cycles?"
        )
    try:
        out_dir.mkdir(parents=True, exist_ok=True)
        return write_document(_blocks(recording, out_dir), out_dir, "report")
    except OSError as error:
        raise ReportError(f"cannot write the report to {out_dir}: {error.strerror}") from error


def _blocks(recording: Recording, folder: Path) -> Iterator[Block]:
    scenario = SCENARIOS.get(str(recording.config.get("scenario")))
    name = f"Scenario {scenario.name}" if scenario else "Run"
    yield Heading(f"{name}: {recording.path.name}", level=1)
    yield Table(("", ""), list(_facts(recording)))
    if recording.is_truncated:
        yield Paragraph(
            "The recording ends early (its writer was killed) or is damaged from some point on;"
            " this report covers what is there."
        )
    if recording.part is not None and (len(recording.parts) > 1 or recording.part.number > 1):
        yield Paragraph(_parts(recording.part, len(recording.parts)))
    yield Heading("Figures")
    metrics: Metrics | None = None
    try:
        metrics = (
            measure_scenario(recording.samples, scenario)
            if scenario
            else measure(recording.samples)
        )
    except MetricsError as error:
        yield Paragraph(f"No figures: {error}.")
    else:
        yield from _figures(metrics, scenario)
        yield from map(Paragraph, remarks(metrics, recording, scenario))
    yield Heading("Plots")
    yield from _plots(recording, metrics, folder)
    if metrics is not None:
        yield Heading("Regions and dissipation")
        rows = trajectory_rows(recording.samples)
        yield from manifold_section(rows, metrics.stat_start_s, recording.config, folder)
    yield Heading("Timing")
    yield from _timing(recording, folder)
    yield Heading("Events")
    yield from _events(recording)


def _parts(part: Part, count: int) -> str:
    if count == 1:
        return f"This is part {part.number} of a longer run; others have a report of their own."
    return f"Parts {part.number} to {part.number + count - 1} of one run, read as one."


def _setting(config: Mapping[str, Any], path: str) -> Any:  # noqa: ANN401 - JSON
    """Return the setting at `table.key`, or None where the configuration has none."""
    value: Any = config
    for key in path.split("."):
        value = value.get(key) if isinstance(value, Mapping) else None
    return value


def _facts(recording: Recording) -> Iterator[tuple[str, str]]:
    rows = recording.samples
    yield "recorded", f"{len(rows)} samples over {np.ptp(rows['t_ns'].astype(np.int64)) / 1e9:g} s"
    yield "back-end", _back_end(recording)
    yield "joints", str(recording.joints)
    for title, path in _FACTS.items():
        value = _setting(recording.config, path)
        if value is not None:
            yield title, _plain(value)


def _back_end(recording: Recording) -> str:
    """Say what was controlled, and by which machine, as far as the recording tells."""
    if recording.has_truth:
        return "simulation in virtual time, the plant's truth recorded"
    start = next((event.detail for event in recording.events if event.kind == "start"), {})
    amplifiers = ", ".join(dict.fromkeys(start.get("amplifiers", ["unknown amplifiers"])))
    mode = "lockstep" if start.get("is_lockstep") else "by the clock"
    host = (
        f"{start.get('scheduler', '?')} on {start.get('kernel', '?')}, {start.get('machine', '?')}"
    )
    return f"{amplifiers} on {_setting(recording.config, 'bus.address')}, {mode}; loop: {host}"


def _plain(value: Any) -> str:  # noqa: ANN401 - JSON
    return ", ".join(map(_plain, value)) if isinstance(value, list) else str(value)


def _figures(metrics: Metrics, scenario: Scenario | None) -> Iterator[Block]:
    window = f"{metrics.stat_start_s:g} s to {metrics.duration_s:g} s"
    yield Paragraph(
        f"Steady state is taken from {window} along the trajectory; errors are in counts of a"
        " 12-bit encoder (1.534 mrad)."
    )
    if scenario is None:
        titles = [f"joint {joint + 1}" for joint in range(len(metrics.Kd_max))]
        yield Table(("figure", "unit", *titles), list(_figure_rows(metrics)))
        return
    results = check(metrics, scenario)
    failed = sum(not result.passed for result in results)
    verdict = f"{failed} of {len(results)} are not met." if failed else "All are met."
    yield Paragraph(
        f"Held against the {len(results)} bounds of scenario {scenario.name}: {verdict}"
    )
    titles = ["figure", "joint", "value", "bound", "unit", "verdict"]
    yield Table(titles, [table_row(result) for result in results])


def _figure_rows(metrics: Metrics) -> Iterator[tuple[str, ...]]:
    for name, unit in UNITS.items():
        for label, values in figures_named(metrics, name):
            yield label, unit, *map(format_figure, values)


def remarks(metrics: Metrics, recording: Recording, scenario: Scenario | None) -> list[str]:
    """Say what the reader should not expect of these figures, where it applies to this run.

    Source: tau = -Kd S has to carry the torque the motion needs, whatever the gains.
    """
    S, torque = _slow_peaks(trajectory_rows(recording.samples), metrics.stat_start_s)
    law = str(_setting(recording.config, "controller.law.name") or "")
    offset = (
        "S does not settle at zero: tau = -Kd S has to carry the torque that the motion needs, so"
        f" S settles at -Y_r Theta / Kd. Here, averaged over {_AVERAGE_CYCLES} cycles, |S| reaches"
        f" {_joined(S)} rad/s for a torque of {_joined(torque)} Nm. S_q can vanish only under a"
        " constant load."
    )
    found = [_MODEL_REMARK if law in MODEL_BASED else offset]
    if law.startswith("self_tuning"):
        found.append(_SELF_TUNING_REMARK)
    if _setting(recording.config, "controller.velocity.estimator") == "levant":
        found.append(_LEVANT_REMARK)
    if scenario is not None and not scenario.is_tracking:
        found.append(
            f"This arm is not tracked (rms {_joined(metrics.measured.rms_counts)} counts). That is"
            " expected; the bounds of this scenario describe how it fails:" + _RANGE_REMARK
        )
    elif max(torque) > _LIGHT_TORQUE_Nm and law not in MODEL_BASED:
        found.append("This run is outside the range of the published gains:" + _RANGE_REMARK)
    return found


def _slow_peaks(rows: Records, from_s: float) -> tuple[Sequence[float], Sequence[float]]:
    """Return the largest |S| and |torque| of the steady state per joint, chatter averaged out."""
    steady = rows[rows["t_ref_s"] >= from_s]
    width = min(_AVERAGE_CYCLES, len(steady))
    peaks = []
    for columns in (steady["S_rad_s"].T, steady["tau_sent_Nm"].T):
        sums = (np.convolve(column, np.ones(width), "valid") for column in columns)
        peaks.append([float(np.abs(total).max()) / width for total in sums])
    return peaks[0], peaks[1]


def _joined(values: Sequence[float]) -> str:
    return " / ".join(format_figure(float(value)) for value in values)


def _plots(recording: Recording, metrics: Metrics | None, folder: Path) -> Iterator[Block]:
    span = _span(recording.samples, metrics)
    figures = draw_run(span, folder)
    beta = _setting(recording.config, "controller.law.beta")
    law = str(_setting(recording.config, "controller.law.name") or "")
    tuner = _setting(recording.config, "controller.law.tuner") or "paper"
    is_fuzzy = law.startswith("self_tuning") and tuner == "paper"
    if isinstance(beta, list) and len(beta) == 3 and is_fuzzy:
        membership = _setting(recording.config, "controller.law.membership") or "sigmoid"
        figures.append(draw_gain_surface(beta, span.rows, folder, membership))
    for figure in figures:
        yield Heading(figure.title, level=3)
        yield Image(figure.path, figure.title, figure.caption)


def _span(samples: Records, metrics: Metrics | None) -> Span:
    """Choose the trajectory if one was measured, else everything."""
    if metrics is not None:
        rows = trajectory_rows(samples)
        return Span(rows, np.asarray(rows["t_ref_s"]), metrics.stat_start_s)
    t_s = (samples["t_ns"] - samples["t_ns"][0]) / 1e9
    return Span(samples, t_s, float(_STEADY_SHARE * t_s[-1]))


def _timing(recording: Recording, folder: Path) -> Iterator[Block]:
    samples = recording.samples
    figures = timing(samples)
    counts = (
        ("cycles", str(figures.cycles)),
        ("samples lost", str(figures.samples_lost)),
        ("overruns (periods skipped)", str(figures.overruns)),
    )
    if not samples["wake_late_ns"].any() and not samples["busy_ns"].any():
        yield Table(("", ""), counts)
        yield Paragraph("The run was in virtual time: lateness and busy time do not exist.")
        return
    spreads = [
        (TIMES[name], *(f"{value:.1f}" for value in values))
        for name, values in spreads_us(samples).items()
    ]
    yield Table(("", ""), [*counts, *_misses(recording), *_usage(recording)])
    yield Table(("[us]", "p50", "p99", "p99.9", "max"), spreads)
    figure = draw_timing(samples, float(np.median(np.diff(samples["t_ns"]))) / 1e3, folder)
    yield Image(figure.path, figure.title, figure.caption)


def _misses(recording: Recording) -> Iterator[tuple[str, str]]:
    """Cycles that missed their deadline, by cause, where the configuration says what that is."""
    period_s = _setting(recording.config, "loop.period_s")
    timeout_s = _setting(recording.config, "loop.feedback_timeout_s")
    if not isinstance(period_s, float) or not isinstance(timeout_s, float):
        return
    misses = misses_of(recording.samples, period_s=period_s, timeout_s=timeout_s)
    for cause, text in CAUSE_TEXTS.items():
        yield f"deadline missed: {text}", str(misses[cause.name.lower()])


def _usage(recording: Recording) -> Iterator[tuple[str, str]]:
    """What the loop process says of the whole run, if its end is in the recording."""
    ends = [event.detail for event in recording.events if event.kind == "timing"]
    for key, text in _USAGE.items():
        if ends and key in ends[-1]:
            yield text, str(ends[-1][key])
    ladder = ends[-1].get("ladder") if ends else None
    if isinstance(ladder, Mapping):
        yield "feedback ladder (cycles)", ", ".join(f"{n} {name}" for name, n in ladder.items())


def _events(recording: Recording) -> Iterator[Block]:
    events = recording.events
    if not events:
        yield Paragraph("None.")
        return
    start_ns = int(recording.samples["t_ns"][0])
    rows = [
        (f"{(event.t_ns - start_ns) / 1e9:.3f}", str(event.cycle), event.kind, _detail(event))
        for event in events[:_MOST_EVENTS]
    ]
    yield Table(("t [s]", "cycle", "event", "detail"), rows)
    if len(events) > _MOST_EVENTS:
        yield Paragraph(f"{len(events) - _MOST_EVENTS} more are in the recording.")


def _detail(event: RecordedEvent) -> str:
    given = ((key, value) for key, value in event.detail.items() if value != "")
    return ", ".join(f"{key} = {_plain(value)}" for key, value in given)
