"""Laws side by side."""

import csv
import json
import platform
import re
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from importlib.metadata import version
from typing import get_args

import pytest

from controller.settings import LawSettings, VelocitySettings
from hil.batch import simulate
from hil.compare import (
    ALL_LAWS,
    CLIPPED,
    FIGURES,
    LAWS,
    PERTURBATIONS,
    REFERENCE,
    SCENARIOS,
    VARIANTS,
    Case,
    CompareError,
    Row,
    cases,
    compare,
    configure,
    full,
    select,
)
from hil.compare_page import PERTURBATION_NOTES, cover_page
from hil.compare_plots import draw_comparison
from hil.compare_progress import FILE_NAME, Progress
from hil.compare_tables import to_csv, to_markdown
from hil.messages import KellyRequest
from tests.hil.lab import wait_until

NOMINAL = ("bench_h kelly_4", "nominal")


@pytest.fixture(scope="module")
def rows():
    wanted = [Case(law, *NOMINAL) for law in (CLIPPED, "computed torque", "pid Kd=1")]
    ticks = []
    found = compare(wanted, 2, ticks.append)
    assert len(ticks) == 4  # the clipped law needs the peak torque of a run nobody asked for
    return dict(zip([case.law for case in wanted], found, strict=True))


@pytest.mark.timeout(300)
def test_compare__clipped_law__peak_torque_of_the_self_tuned_one(rows):
    assert rows[CLIPPED].peak_tau_Nm == pytest.approx((2.0, 3.75), rel=0.005)
    assert rows[CLIPPED].Kd_min == rows[CLIPPED].Kd_max == (4.0, 4.0)


def test_compare__known_laws__figures_of_an_independent_simulation(rows):
    assert rows[CLIPPED].rms_counts[0] == pytest.approx(1.21, rel=0.05)
    assert rows["pid Kd=1"].rms_counts[0] == pytest.approx(4.89, rel=0.05)
    assert rows["computed torque"].rms_counts[0] == pytest.approx(0.18, rel=0.15)


def test_to_csv__rows__every_figure_of_every_joint(rows):
    table = list(csv.DictReader(to_csv(list(rows.values())).splitlines()))
    assert [row["law"] for row in table] == list(rows)
    assert len(table[0]) == 4 + 2 * len(FIGURES)
    assert float(table[0]["rms_1_counts"]) == rows[CLIPPED].rms_counts[0]
    assert float(table[0]["peak_tau_2_Nm"]) == rows[CLIPPED].peak_tau_Nm[1]


def test_to_markdown__rows__one_table_with_every_law(rows):
    text = to_markdown(list(rows.values()))
    assert text.count("### bench_h kelly_4, nominal") == 1
    assert all(f"| {law} |" in text for law in rows)


def test_draw_comparison__rows__one_picture_per_scenario(rows, tmp_path):
    (path,) = draw_comparison(list(rows.values()), tmp_path)
    assert path.stat().st_size > 10_000


@pytest.mark.parametrize("perturbation", PERTURBATIONS)
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_configure__every_perturbation__changes_plant_or_platform_only(scenario, perturbation):
    nominal = configure(Case(REFERENCE, scenario, "nominal"))
    changed = configure(Case(REFERENCE, scenario, perturbation))
    assert changed.controller == nominal.controller
    is_changed = (changed.plant, changed.servos) != (nominal.plant, nominal.servos)
    assert is_changed == (perturbation != "nominal")


@pytest.mark.parametrize("law", LAWS)
def test_configure__every_law__valid(law):
    assert configure(Case(law, *NOMINAL)).controller.law.name == LAWS[law]["law"]["name"]


@pytest.mark.parametrize("law", VARIANTS)
def test_configure__every_variant__is_the_reference_with_one_setting_changed(law):
    reference = configure(Case(REFERENCE, *NOMINAL)).controller.model_dump()
    changed = configure(Case(law, *NOMINAL)).controller.model_dump()
    group, name = next(
        (group, name)
        for group in ("law", "velocity")
        for name in reference[group]
        if reference[group][name] != changed[group][name]
    )
    assert law == f"{'velocity' if group == 'velocity' else name} {changed[group][name]}"
    changed[group][name] = reference[group][name]
    assert changed == reference


def test_all_laws__every_choice_of_the_settings__can_be_compared():
    """Whatever a setting of law or estimator can be is put beside the rest by some name."""
    met = [configure(Case(law, *NOMINAL)).controller for law in ALL_LAWS]
    for name in ("name", "manifold", "membership", "adaptation", "tuner"):
        choices = get_args(LawSettings.model_fields[name].annotation)
        assert {getattr(controller.law, name) for controller in met} == set(choices), name
    estimators = set(get_args(VelocitySettings.model_fields["estimator"].annotation))
    # these amplifiers report no velocity
    assert {controller.velocity.estimator for controller in met} == estimators - {"amplifier"}


def test_select__unknown_name__lists_those_there_are():
    with pytest.raises(CompareError, match="law 'pdi' is not one of: self-tuning pid, "):
        select(["pdi"], LAWS, "law")


def test_cases__names__every_combination():
    assert len(cases(LAWS, SCENARIOS, PERTURBATIONS)) == len(LAWS) * len(SCENARIOS) * len(
        PERTURBATIONS
    )


def test_full__cases__every_law_everywhere_and_every_variant_nominally():
    wanted = full()
    assert len(set(wanted)) == len(wanted)
    laws = len(LAWS) * len(PERTURBATIONS) + len(VARIANTS)
    assert len(wanted) == laws * len(SCENARIOS)


# --- the page and the progress --------------------------------------------------------------------


def test_cover_page__rows__says_what_made_it_and_explains_every_name(rows):
    page = cover_page(list(rows.values()), "hil compare --quick --out x", ["a.png"])
    assert "| command | `hil compare --quick --out x` |" in page
    assert f"hil {version('hil')}" in page
    assert platform.release() in page
    assert "3, 0 of them tripped" in page
    for law in rows:
        assert f"| {law} | `law.name = " in page
    assert "](a.png)" in page


def test_perturbation_notes__every_perturbation__has_one():
    assert set(PERTURBATION_NOTES) == set(PERTURBATIONS)


def test_cover_page__tripped_run__is_counted_and_shown():
    row = Row(Case(REFERENCE, *NOMINAL), failed="the arm went into FAULT (VELOCITY)")
    page = cover_page([row], "hil compare", [])
    assert "1, 1 of them tripped" in page
    assert f"| {REFERENCE} | tripped |" in page


@pytest.mark.timeout(100)
def test_command__law_that_trips__told_and_only_a_failure_if_it_was_the_only_one(tmp_path):
    command = [sys.executable, "-m", "hil", "compare", "--perturbation", "nominal"]
    command += ["--scenario", "pelican_h kelly_4", "--law", "velocity levant"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=90, check=False)
    assert done.returncode == 1
    assert done.stderr == "hil: 1 of 1 runs tripped; the tables say why\n"
    assert "ESTIMATOR_LOST" in done.stdout


def test_simulate__arm_that_trips_in_the_stop_after_it__figures_all_the_same():
    """The payload, of which the stop knows nothing, is let down too fast after the trajectory."""
    config = configure(Case("pid Kd=1", "pelican_v kelly_4", "payload +50 %"))
    request = KellyRequest(duration_s=8.0, rate=0.25, approach="none")
    figures = simulate(config, request)
    assert figures.rms_counts[0] > 100.0
    assert figures.peak_tau_Nm[0] > 5.0


def interrupt(directory, some):
    """Leave the rows of a comparison that was interrupted."""
    with suppress(KeyboardInterrupt), Progress(directory) as progress:
        assert progress.rows == {}
        for row in some:
            progress.add(row)
        raise KeyboardInterrupt


def test_progress__interrupted__same_rows_again_bit_for_bit(rows, tmp_path):
    some = list(rows.values())
    interrupt(tmp_path, some)
    with (tmp_path / FILE_NAME).open("a") as file:
        file.write('{"case": {"law": "pi')  # killed while writing
    with Progress(tmp_path) as progress:
        assert list(progress.rows.values()) == some
        assert set(progress.rows) == {row.case for row in some}
    assert not (tmp_path / FILE_NAME).exists()


def test_progress__rows_of_another_program__are_run_again(rows, tmp_path):
    path = tmp_path / FILE_NAME
    interrupt(tmp_path, [rows[CLIPPED]])
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0].replace('": "', '": "0'), *lines[1:]]))
    with Progress(tmp_path) as progress:
        assert progress.rows == {}


def test_compare__all_known__nothing_is_run(rows):
    clipped = rows[CLIPPED]
    first = replace(clipped, case=Case(REFERENCE, *NOMINAL))
    known = {row.case: row for row in (clipped, first)}
    ticks = []
    assert compare([Case(CLIPPED, *NOMINAL)], 1, ticks.append, known) == [clipped]
    assert ticks == []


@pytest.mark.timeout(300)
def test_command__interrupted_and_started_again__goes_on_and_leaves_the_page(tmp_path):
    command = [sys.executable, "-m", "hil", "compare", "--processes", "1", "--out", "out"]
    command += ["--scenario", "bench_h kelly_4", "--perturbation", "nominal"]
    command += ["--law", "pid Kd=1", "--law", "pd Kd=4"]
    unfinished = tmp_path / "out" / FILE_NAME
    with subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        wait_until(
            lambda: unfinished.exists() and unfinished.read_text().count("\n") == 2,
            60.0,
            "the first row",
        )
        process.send_signal(signal.SIGINT)
        _, complaint = process.communicate(timeout=60)
    assert (process.returncode, complaint.splitlines()[-1]) == (130, "hil: interrupted")
    assert "Traceback" not in complaint
    kept = unfinished.read_text().splitlines()[1]
    again = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, timeout=100, check=False
    )
    assert again.returncode == 0, again.stderr
    assert not unfinished.exists()
    page = (tmp_path / "out" / "README.md").read_text()
    assert "`hil compare --law 'pid Kd=1' --law 'pd Kd=4' --scenario 'bench_h kelly_4'" in page
    table = list(csv.DictReader((tmp_path / "out" / "compare.csv").read_text().splitlines()))
    assert [row["law"] for row in table] == ["pid Kd=1", "pd Kd=4"]
    assert float(table[0]["rms_1_counts"]) == json.loads(kept)["rms_counts"][0]
    for target in re.findall(r"\]\(([^)]+)\)", page):
        assert (tmp_path / "out" / target).is_file()
