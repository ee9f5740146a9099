import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.document import Heading, Image, Paragraph, Table, write_document
from hil.metrics import measure
from hil.plots import thinned
from hil.recording import Recording, RecordingError, RecordingWriter
from hil.report import ReportError, remarks, write_report
from hil.scenarios import find_scenario
from hil.telemetry import SampleLayout
from tests.hil.closed_loop import PELICAN, payloads, run, run_named

CONFIG = {
    "scenario": "A",
    "arm": {"name": "bench", "preset": "bench_h"},
    "controller": {
        "law": {"name": "self_tuning_pid", "adaptation": "literal", "beta": [1.0, 2.0, 4.0]},
        "velocity": {"estimator": "filtered_difference"},
    },
}
RUN_PLOTS = {
    "fig08_S.png",
    "fig09_position_error.png",
    "fig10_velocity_error.png",
    "fig11_torque.png",
    "fig12_Kd.png",
}
PNG = b"\x89PNG\r\n\x1a\n"


def record(path: Path, config, rows) -> Path:
    with RecordingWriter(path, config, joints=2, with_truth=True) as writer:
        writer.add_event(0, 0, "state", {"to": "ACTIVE"})
        for k, payload in enumerate(payloads(rows)):
            writer.add_sample(int(rows["t_ns"][k]), k, payload)
    return path


def record_made(path: Path, joints: int, cycles: int) -> Path:
    """A recording from hardware: no truth, no trajectory, no configuration."""
    layout = SampleLayout(joints, with_truth=False)
    write, buffer = layout.writer(), bytearray(layout.size)
    with RecordingWriter(path, {}, joints, with_truth=False) as writer:
        for k in range(cycles):
            lists = [[np.sin(0.1 * k + j) for j in range(joints)] for _ in layout.list_names]
            write(buffer, 0, [k, k, k * 1_000_000, *[0] * (len(layout.scalar_names) - 3)], lists)
            writer.add_sample(k * 1_000_000, k, bytes(buffer))
    return path


@pytest.fixture(scope="module")
def scenario_report(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("report")
    path = record(folder / "a.mcap", CONFIG, run_named("A"))
    return write_report(path, folder / "deep" / "report")


def test_write_report__scenario_run__verdict_of_every_bound(scenario_report):
    text = scenario_report.with_suffix(".md").read_text()
    assert "# Scenario A: a.mcap" in text
    assert "Held against the 21 bounds of scenario A: All are met." in text
    assert len(re.findall(r"\| PASS \|$", text, re.MULTILINE)) == 21
    assert "| rms_counts | 1 | 1.317 | 0.95 .. 1.65 | counts | PASS |" in text


def test_write_report__scenario_run__says_that_S_does_not_vanish(scenario_report):
    text = scenario_report.with_suffix(".md").read_text()
    assert "S settles at -Y_r Theta / Kd" in text
    assert "self-tuning does not beat a constant Kd = Kd_max" in text
    assert "Levant" not in text


def test_write_report__scenario_run__every_plot_is_a_png_the_markdown_refers_to(scenario_report):
    folder, text = scenario_report.parent, scenario_report.with_suffix(".md").read_text()
    images = set(re.findall(r"!\[.*?\]\((.*?)\)", text))
    assert images == RUN_PLOTS | {"fig06_07_gain.png", "regions.png", "timing.png"}
    for image in images:
        assert (folder / image).read_bytes().startswith(PNG)


def test_write_report__html__needs_no_other_file(scenario_report):
    page = scenario_report.read_text()
    assert scenario_report.name == "report.html"
    assert page.count("src=") == page.count('src="data:image/png;base64,') == 8
    assert '<td class="PASS">PASS</td>' in page


def test_write_report__scenario_run__regions_decay_and_balance_with_and_without_the_plant(tmp_path):
    arm, scenario = PELICAN, find_scenario("E")
    links = [
        {
            "length_m": arm.length_m[j],
            "com_m": arm.com_m[j],
            "mass_kg": arm.mass_kg[j],
            "inertia_kg_m2": arm.inertia_kg_m2[j],
            "viscous_Nms_rad": arm.viscous_Nms_rad[j],
            "coulomb_Nm": arm.coulomb_Nm[j],
            "not_of_the_model": 1,
        }
        for j in (0, 1)
    ]
    plant = {"links": links, "gravity_m_s2": 9.81, "tanh_slope_s_rad": 50.0, "q0_rad": [0, 0]}
    config = {**CONFIG, "scenario": None, "plant": plant}
    rows = run(scenario, duration_s=3.0)
    text = write_report(record(tmp_path / "e.mcap", config, rows), tmp_path)
    section = text.with_suffix(".md").read_text().partition("## Regions and dissipation")[2]
    assert "joint 1 leaves it 2 times" in section
    assert re.search(r"\| decay \| 3\.\d+ \| 1\.\d+ \| 6\d\.\d% \| monitor \|", section)
    found = re.search(r"\| decay \| 2\.\d+ \| 4\.\d+ \| (.*?)% \| plant's own", section)
    assert found is not None
    assert float(found[1]) < 15.0
    law = {"law": {"name": "computed_torque"}}
    rows = run_named("A")[:2000]
    path = record(tmp_path / "c.mcap", {**CONFIG, "scenario": None, "controller": law}, rows)
    section = write_report(path, tmp_path).with_suffix(".md").read_text()
    assert "(36) is not its condition" in section
    assert "monitor |" not in section
    assert "S settles at" not in section


def test_write_report__run_without_scenario__figures_without_verdict(tmp_path):
    config = {**CONFIG, "scenario": None}
    page = write_report(record(tmp_path / "r.mcap", config, run_named("A")[:2000]), tmp_path)
    text = page.with_suffix(".md").read_text()
    assert "# Run: r.mcap" in text
    assert re.search(r"\| rms_counts \(true\) \| counts \| [\d.]+ \| [\d.]+ \|", text)
    assert "PASS" not in text


def test_write_report__recorder_killed_early__says_so_and_why_there_are_no_figures(tmp_path):
    path = record(tmp_path / "run.mcap", CONFIG, run_named("A")[:1500])
    path.write_bytes(path.read_bytes()[:-2000])  # the index is missing
    text = write_report(path, tmp_path).with_suffix(".md").read_text()
    assert "The recording ends early" in text
    assert "No figures: the trajectory ends at 1.4" in text
    assert "s, its statistics start at 12 s" in text
    assert {path.name for path in tmp_path.glob("fig*.png")} >= RUN_PLOTS


def told(name: str, estimator: str) -> str:
    law = {"name": "pid"}
    config = {"controller": {"law": law, "velocity": {"estimator": estimator}}}
    rows, scenario = run_named(name), find_scenario(name)
    recording = Recording(Path("run.mcap"), config, 2, rows, (), is_truncated=False)
    metrics = measure(rows, stat_start_s=scenario.stat_start_s)
    return "\n".join(remarks(metrics, recording, scenario))


def test_remarks__arm_beyond_the_controller__failing_is_expected():
    text = told("E", "filtered_difference")
    assert "This arm is not tracked (rms 113.1 / 1.308 counts). That is expected" in text
    assert "below about 1 Nm" in text


def test_remarks__constant_gain_with_levant__its_price_and_nothing_on_self_tuning():
    text = told("B", "levant")
    assert "about four times the error" in text
    assert "self-tuning" not in text
    assert "not tracked" not in text


def test_write_report__hardware_without_trajectory__plots_and_no_figures(tmp_path):
    page = write_report(record_made(tmp_path / "run.mcap", 3, 50), tmp_path)
    text = page.with_suffix(".md").read_text()
    assert "No figures: no trajectory ran" in text
    assert "virtual time" in text
    assert {path.name for path in tmp_path.glob("*.png")} == RUN_PLOTS


@pytest.mark.parametrize("cycles", [0, 1])
def test_write_report__no_samples__one_clear_line(tmp_path, cycles):
    path = record_made(tmp_path / "run.mcap", 2, cycles)
    with pytest.raises(ReportError, match=rf"run\.mcap holds {cycles} samples: nothing to report"):
        write_report(path, tmp_path / "report")
    assert not (tmp_path / "report").exists()


def test_write_report__same_recording_twice__same_files(tmp_path):
    path = record_made(tmp_path / "run.mcap", 1, 100)
    first, second = (write_report(path, tmp_path / name).parent for name in ("a", "b"))
    files = sorted(file.name for file in first.iterdir())
    assert len(files) == 2 + len(RUN_PLOTS)
    for name in files:
        assert (first / name).read_bytes() == (second / name).read_bytes(), name


def test_write_report__folder_is_a_file__report_error(tmp_path):
    path = record_made(tmp_path / "run.mcap", 1, 10)
    with pytest.raises(ReportError, match=r"cannot write the report to .*run\.mcap"):
        write_report(path, path)


def test_write_report__not_a_recording__recording_error(tmp_path):
    (tmp_path / "x.mcap").write_text("no")
    with pytest.raises(RecordingError):
        write_report(tmp_path / "x.mcap", tmp_path)


# --- documents -----------------------------------------------------------------------------------


def test_write_document__text_with_markup__escaped(tmp_path):
    (tmp_path / "p.png").write_bytes(PNG)
    blocks = [
        Heading("A <b> & c", level=1),
        Paragraph("<script>"),
        Table(("x",), [("a|b",), ("<i>",), ("FAIL",)]),
        Image(tmp_path / "p.png", 'a "title"', "<u>"),
    ]
    page = write_document(blocks, tmp_path, "doc").read_text()
    assert not re.search(r"<(b|script|i|u)>", page)
    assert "<title>A &lt;b&gt; &amp; c</title>" in page
    assert "| a\\|b |" in (tmp_path / "doc.md").read_text()


@given(st.integers(2, 50_000), st.integers(0, 2**32 - 1))
def test_thinned__any_length__keeps_time_order_ends_in_range_and_extremes(count, seed):
    values = np.random.default_rng(seed).normal(size=count)
    t_s, shown = thinned(np.arange(count) * 1.0, values)
    assert len(t_s) <= max(2 * 2000 + 20, 8000)
    assert (np.diff(t_s) >= 0).all()
    assert (shown.min(), shown.max()) == (values.min(), values.max())
    assert np.array_equal(values[t_s.astype(int)], shown)
