import math
from dataclasses import replace

import numpy as np
import pytest

from hil.decay import decay_rates, smoothed_motion
from hil.metrics import MetricsError, check, format_table, measure, timing, trajectory_rows
from hil.scenarios import COUNT_RAD, SCENARIOS, ScenarioError, find_scenario
from hil.telemetry import SampleLayout
from tests.hil.closed_loop import LAYOUT, PELICAN, Law, make_acceleration, rk4, run, run_named

BOUNDED = ["A0", "A", "B", "E"]


def verdicts(name, rows):
    scenario = find_scenario(name)
    return check(measure(rows, stat_start_s=scenario.stat_start_s), scenario)


def failed(name, rows) -> set[str]:
    results = verdicts(name, rows)
    return {
        r.name if r.name == "duration_s" else f"{r.name} {r.joint}" for r in results if not r.passed
    }


def made_rows(count=2000, joints=2, with_truth=True):
    """Samples of a trajectory that is followed exactly."""
    rows = np.zeros(count, SampleLayout(joints, with_truth).dtype)
    rows["seq"] = rows["cycle"] = np.arange(count)
    rows["t_ns"] = np.arange(count) * 1_000_000
    rows["t_ref_s"] = np.arange(count) * 1e-3
    return rows


# --- the table of bounds against an independent closed loop -------------------------------------


@pytest.mark.parametrize("name", BOUNDED)
def test_check__right_implementation__meets_every_bound_of_its_row(name):
    assert failed(name, run_named(name)) == set()


@pytest.mark.parametrize(
    ("law", "expected"),
    [
        (Law(Ki=0.0), "rms_counts 1"),
        (Law(beta=(4.0, 2.0, 1.0)), "peak_tau_Nm 1"),
    ],
    ids=["no integral", "rules swapped"],
)
def test_check__wrong_implementation__leaves_row_A(law, expected):
    assert expected in failed("A", run(find_scenario("A"), law))


def test_check__run_cut_short__length_fails():
    rows = run_named("A")[:19_000]
    assert "duration_s" in failed("A", rows)


def test_check__encoder_wrongly_scaled__seen_in_the_truth_alone():
    rows = run_named("A").copy()
    rows["q_true_rad"] *= 1.01
    assert {name for name in failed("A", rows) if "rms" in name} == {
        "rms_counts (true) 1",
        "rms_counts (true) 2",
    }


def test_check__nan_in_the_error__fails():
    rows = run_named("A").copy()
    rows["q_meas_rad"][15_000, 1] = np.nan
    assert "rms_counts 2" in failed("A", rows)


def test_check__arm_with_one_joint__second_joint_fails():
    rows = made_rows(20_000, joints=1)
    assert {r.passed for r in verdicts("A", rows) if r.joint == 2} == {False}


def test_scenario_E__tracking__reported_as_beyond_the_controller():
    assert [s.name for s in SCENARIOS.values() if not s.is_tracking] == ["E"]
    assert measure(run_named("E"), stat_start_s=40.0).measured.ts20_s[0] > 51.0


def test_find_scenario__unknown_name__lists_the_known():
    with pytest.raises(ScenarioError, match="'X' is not one of: A0, A, B, E"):
        find_scenario("X")


def test_scenario__bounds__name_figures_that_are_measured():
    rows = made_rows(100)
    for scenario in SCENARIOS.values():
        results = check(measure(rows), replace(scenario, duration_s=0.0))
        assert len(results) > len(scenario.bounds)
        assert format_table(results)


# --- single figures from rows whose values are known ---------------------------------------------


def test_measure__constant_error__rms_and_peak_are_that_error():
    rows = made_rows()
    rows["q_meas_rad"][:, 0] = 3 * COUNT_RAD
    rows["q_meas_rad"][1500, 1] = -5 * COUNT_RAD
    rows["q_true_rad"][:, 0] = 2 * COUNT_RAD
    metrics = measure(rows, stat_start_s=1.0)
    assert metrics.measured.rms_counts[0] == pytest.approx(3.0)
    assert metrics.measured.peak_counts == pytest.approx((3.0, 5.0))
    assert metrics.true is not None
    assert metrics.true.rms_counts == pytest.approx((2.0, 0.0))


def test_measure__error_before_the_window__not_in_its_statistics():
    rows = made_rows()
    rows["q_meas_rad"][:999] = 1.0
    metrics = measure(rows, stat_start_s=1.0)
    assert metrics.measured.peak_counts == (0.0, 0.0)
    assert metrics.measured.ts20_s == (0.998, 0.998)


def test_measure__no_window_given__last_forty_percent():
    rows = made_rows(1001)
    assert measure(rows).stat_start_s == pytest.approx(0.6)


def test_measure__torque_square_wave__total_variation_peak_and_gain_range():
    rows = made_rows(2001)
    rows["tau_sent_Nm"][:, 0] = np.where(np.arange(2001) % 2, 0.25, -0.25)
    rows["tau_sent_Nm"][3, 1] = -7.0
    rows["Kd"] = np.linspace(1.5, 3.5, 2001)[:, None]
    metrics = measure(rows, stat_start_s=1.0)
    assert metrics.tv_Nm_s == pytest.approx((500.0, 0.0))
    assert metrics.peak_tau_Nm == (0.25, 7.0)
    assert (metrics.Kd_min, metrics.Kd_max) == ((1.5, 1.5), (3.5, 3.5))


def test_measure__exponential_decay__rate_is_its_exponent():
    rows = made_rows()
    rows["dq_true_rad_s"] = np.exp(-rows["t_ref_s"][:, None] * np.array([12.0, 80.0]))
    rows["dq_meas_rad_s"] = rows["S_rad_s"] = 7.0  # whatever the estimator says
    assert measure(rows).rate10_1_s == pytest.approx((12.0, 80.0), rel=0.05)


def test_measure__no_initial_error__rate_is_not_a_number():
    assert all(math.isnan(rate) for rate in measure(made_rows()).rate10_1_s)


@pytest.mark.parametrize("name", BOUNDED)
def test_decay_rates__no_truth__smoothed_encoder_comes_close(name):
    rows = run_named(name)
    known = SampleLayout(2, with_truth=False).dtype
    measured = np.zeros(len(rows), known)
    for field in known.names or ():
        measured[field] = rows[field]
    assert decay_rates(measured) == pytest.approx(decay_rates(rows), rel=0.12)


def test_smoothed_motion__parabola_with_skipped_cycles__exact_and_without_lag():
    t_s = np.delete(np.arange(300) * 1e-3, [50, 51, 200])
    q = np.column_stack((2.0 + 3.0 * t_s, 1.0 - t_s))
    smooth, rate = smoothed_motion(t_s, q)
    assert smooth == pytest.approx(q)
    assert rate == pytest.approx(np.broadcast_to([3.0, -1.0], rate.shape))
    _, rate = smoothed_motion(t_s[:50], np.square(t_s[:50, None]))
    assert rate == pytest.approx(2.0 * t_s[:50, None])


# --- which rows count ----------------------------------------------------------------------------


def test_trajectory_rows__hold_before_and_after__only_the_trajectory_from_its_zero():
    rows = made_rows(300)
    rows["t_ref_s"] = np.concatenate((np.zeros(101), np.arange(1, 150) * 1e-3, np.zeros(50)))
    rows["q_des_rad"][:100] = 0.4  # held until the reference steps at row 100
    rows["q_des_rad"][100:250] = np.arange(150)[:, None] * 1e-4
    chosen = trajectory_rows(rows)
    assert (chosen["cycle"][0], chosen["cycle"][-1]) == (100, 249)


def test_trajectory_rows__first_sample_after_the_hold_is_at_one_period__hold_left_out():
    rows = made_rows(200)
    rows["t_ref_s"] = np.concatenate((np.zeros(100), np.arange(1, 101) * 1e-3))
    rows["q_des_rad"][:100] = 0.4
    assert trajectory_rows(rows)["cycle"][0] == 100


def test_trajectory_rows__reference_waits_for_missing_feedback__one_trajectory():
    rows = made_rows(300)
    rows["t_ref_s"] = np.concatenate((np.arange(100), [99, 99, 99], np.arange(100, 297))) * 1e-3
    assert len(trajectory_rows(rows)) == 300


def test_trajectory_rows__two_trajectories__the_longer():
    rows = made_rows(300)
    rows["t_ref_s"] = np.concatenate((np.arange(80), np.arange(220))) * 1e-3
    chosen = trajectory_rows(rows)
    assert (chosen["cycle"][0], len(chosen)) == (80, 220)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.zeros(0, LAYOUT.dtype), "holds no samples"),
        (np.zeros(10, LAYOUT.dtype), "no trajectory ran"),
        (made_rows(10), "ends at 0.009 s, its statistics start at 12 s"),
    ],
    ids=["empty", "hold only", "stopped early"],
)
def test_measure__nothing_to_measure__says_why(rows, message):
    with pytest.raises(MetricsError, match=message):
        measure(rows, stat_start_s=12.0)


def test_timing__gaps_and_lateness__counted_and_spread():
    rows = made_rows(1000)[np.r_[0:400, 403:1000]]
    rows["wake_late_ns"] = np.arange(len(rows)) * 1000
    rows["busy_ns"] = 80_000
    rows["overruns"][-1] = 3
    figures = timing(rows)
    assert (figures.cycles, figures.samples_lost, figures.overruns) == (997, 3, 3)
    assert figures.wake_late_us == pytest.approx((498.0, 986.04, 996.0))
    assert figures.busy_us == (80.0, 80.0, 80.0)


# --- the verdict ---------------------------------------------------------------------------------


def test_format_table__failing_run__aligned_and_counted():
    text = format_table(verdicts("A", run_named("B")))
    table, _, last = text.rpartition("\n")
    lines = table.strip().splitlines()
    assert (
        len({line.index(word) for line in lines for word in ("PASS", "FAIL") if word in line}) == 1
    )
    wrong = sum(line.endswith("FAIL") for line in lines)
    assert wrong >= 4
    assert last == f"{wrong} of {len(lines) - 2} bounds FAIL"


def test_format_table__passing_run__says_so():
    assert format_table(verdicts("A", run_named("A"))).endswith("all bounds PASS (21 checked)")


# --- the closed loop itself ----------------------------------------------------------------------


def test_closed_loop__frictionless_swing__keeps_its_energy():
    arm = replace(PELICAN, viscous_Nms_rad=(0.0, 0.0), coulomb_Nm=(0.0, 0.0))
    acceleration, state = make_acceleration(arm, 9.81), (1.0, -0.5, 0.0, 0.0)

    def energy(q1, q2, v1, v2):
        (l1, _), (c1, c2), (m1, m2), (i1, i2) = (
            arm.length_m,
            arm.com_m,
            arm.mass_kg,
            arm.inertia_kg_m2,
        )
        v_elbow, v_fore = l1 * v1, c2 * (v1 + v2)
        squares = v_elbow**2 + v_fore**2 + 2 * v_elbow * v_fore * math.cos(q2)
        kinetic = i1 * v1**2 + i2 * (v1 + v2) ** 2 + m1 * (c1 * v1) ** 2 + m2 * squares
        height = m1 * c1 * math.cos(q1) + m2 * (l1 * math.cos(q1) + c2 * math.cos(q1 + q2))
        return 0.5 * kinetic - 9.81 * height

    before = energy(*state)
    for _ in range(4000):
        state = rk4(acceleration, state, ((0.0, 0.0),) * 3, 5e-4)
    assert abs(state[2]) + abs(state[3]) > 0.01
    assert energy(*state) == pytest.approx(before, abs=1e-6)
