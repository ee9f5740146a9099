"""What a recorded run shows, in words for a terminal: figures, and for a scenario the verdict."""

from hil.metrics import Metrics, check, format_figure, format_table, measure, measure_scenario
from hil.recording import Recording
from hil.scenarios import SCENARIOS


def judge(recording: Recording) -> tuple[str, bool]:
    """Return the text, and whether every bound of the run's scenario is met (True without one).

    Raises:
        MetricsError: If no trajectory ran in it.
    """
    scenario = SCENARIOS.get(recording.config.get("scenario") or "")
    if scenario is None:
        return _figures(measure(recording.samples)), True
    metrics = measure_scenario(recording.samples, scenario)
    results = check(metrics, scenario)
    head = (
        f"scenario {scenario.name} ({scenario.preset}), statistics from {scenario.stat_start_s:g} s"
    )
    expected = "" if scenario.is_tracking else (
        "\nThese bounds describe a failure to track: here the published gains cannot carry gravity."
    )  # fmt: skip
    return f"{head}\n{format_table(results)}{expected}", all(r.passed for r in results)


def _figures(metrics: Metrics) -> str:
    joints = range(1, len(metrics.Kd_min) + 1)
    rows = (
        ("rms error [counts]", metrics.measured.rms_counts),
        ("peak error [counts]", metrics.measured.peak_counts),
        ("peak torque [Nm]", metrics.peak_tau_Nm),
        ("torque variation [Nm/s]", metrics.tv_Nm_s),
        ("smallest Kd [Nms/rad]", metrics.Kd_min),
        ("largest Kd [Nms/rad]", metrics.Kd_max),
    )
    head = f"{'over t >= ' + format_figure(metrics.stat_start_s) + ' s':26}"
    lines = [head + "".join(f"{f'joint {j}':>10}" for j in joints)]
    lines += [f"{name:26}" + "".join(f"{format_figure(v):>10}" for v in row) for name, row in rows]
    return "\n".join(lines)
