"""Laws side by side."""

import csv

import pytest

from hil.compare import (
    CLIPPED,
    FIGURES,
    LAWS,
    PERTURBATIONS,
    REFERENCE,
    SCENARIOS,
    Case,
    CompareError,
    cases,
    compare,
    configure,
    select,
    to_csv,
    to_markdown,
)
from hil.compare_plots import draw_comparison

NOMINAL = ("bench_h kelly_4", "nominal")


@pytest.fixture(scope="module")
def rows():
    wanted = [Case(law, *NOMINAL) for law in (CLIPPED, "computed torque", "pid Kd=1")]
    ticks = []
    found = compare(wanted, 2, lambda: ticks.append(1))
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
    assert configure(Case(law, *NOMINAL)).controller.law.name == LAWS[law]["name"]


def test_select__unknown_name__lists_those_there_are():
    with pytest.raises(CompareError, match="law 'pdi' is not one of: self-tuning pid, "):
        select(["pdi"], LAWS, "law")


def test_cases__names__every_combination():
    assert len(cases(LAWS, SCENARIOS, PERTURBATIONS)) == len(LAWS) * len(SCENARIOS) * len(
        PERTURBATIONS
    )
