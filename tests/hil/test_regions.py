"""Regions, decay and dissipation: of rows whose figures are known, and of whole runs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from controller.settings import ModelSettings
from hil.config import load_config
from hil.experiment import Memory, play_in_simulation, scenario_request, scenario_settings
from hil.metrics import trajectory_rows
from hil.regions import fit_decay, has_monitors, measure_manifold, model_powers, plant_of
from hil.scenarios import find_scenario
from hil.telemetry import SampleLayout
from tests.hil.closed_loop import run

LINK = {"length_m": 0.3, "com_m": 0.1, "mass_kg": 1.0, "inertia_kg_m2": 0.02,
        "viscous_Nms_rad": 0.2, "coulomb_Nm": 0.5}  # fmt: skip
HORIZONTAL = ModelSettings(links=[LINK])


def made_rows(S, steps=2000, joints=1):
    """Samples of a trajectory at 1 kHz along which S of every joint is as given over time."""
    rows = np.zeros(steps, SampleLayout(joints, with_truth=True).dtype)
    rows["t_ref_s"] = np.arange(steps) * 1e-3
    rows["S_rad_s"] = S(rows["t_ref_s"][:, None])
    rows["dq_true_rad_s"] = rows["dq_meas_rad_s"] = 1.5
    rows["q_true_rad"] = rows["q_meas_rad"] = 1.5 * rows["t_ref_s"][:, None]
    rows["Kd"] = 2.0
    return rows


# --- decay --------------------------------------------------------------------------------------


def test_fit_decay__exponentials__their_rates_and_levels():
    t_s = np.arange(2000) * 1e-3
    rates, levels = np.array([5.0, 40.0]), np.array([-2.0, 3.7])
    decay = fit_decay(t_s, levels * np.exp(-t_s[:, None] * rates))
    assert decay.rate_1_s == pytest.approx(rates)
    assert decay.level_rad_s == pytest.approx(np.abs(levels))
    assert decay.r_squared == pytest.approx((1.0, 1.0))
    assert decay.duration_s == pytest.approx(math.log(10.0) / rates, abs=1.1e-3)


def test_fit_decay__straight_line__explained_less():
    t_s = np.arange(2000) * 1e-3
    decay = fit_decay(t_s, 2.0 - t_s[:, None])
    assert decay.duration_s == pytest.approx((1.8,), abs=2e-3)
    assert 0.8 < decay.r_squared[0] < 0.95


@pytest.mark.parametrize(
    "S",
    [
        lambda t: 0.05 * np.exp(-9.0 * t),  # starts within the noise
        lambda t: 2.0 + 0.0 * t,  # stays
        lambda t: np.where(t < 3e-3, 2.0, 0.0),  # over before a line can be fitted
    ],
    ids=["small", "stays", "jumps"],
)
def test_fit_decay__nothing_to_fit__not_a_number(S):
    t_s = np.arange(2000) * 1e-3
    decay = fit_decay(t_s, S(t_s[:, None]))
    assert all(math.isnan(value[0]) for value in (decay.rate_1_s, decay.duration_s))


def test_fit_decay__size_constant_then_gone__rate_zero_and_no_share():
    t_s = np.arange(100) * 1e-3
    decay = fit_decay(t_s, np.where(t_s < 20e-3, 2.0, 0.0)[:, None])
    assert decay.rate_1_s == pytest.approx((0.0,), abs=1e-12)
    assert not decay.r_squared[0] > 1.0


# --- regions and bound ----------------------------------------------------------------------------


def test_measure_manifold__known_crossings__counted_without_and_with_noise():
    rows = made_rows(lambda t: 1.5 * np.cos(2.0 * np.pi * t))  # below 1 four times in 2 s
    rows["Omega_Kd_entries"] = 3.0 + 10.0 * rows["t_ref_s"][:, None]
    rows["Omega_Kd_exits"] = 7.0
    rows["tau_need_Nm"] = 0.6
    found = measure_manifold(rows, 1.0).regions
    assert found.entered_s == pytest.approx((math.acos(1 / 1.5) / (2.0 * math.pi),), abs=1e-3)
    assert (found.entries, found.exits) == ((4.0,), (4.0,))
    assert found.counted_entries == pytest.approx((19.99,))
    assert found.counted_exits == (0.0,)
    assert found.bound_rad_s == found.seen_bound_rad_s == pytest.approx((1.5,))
    assert found.load_bound_rad_s == pytest.approx((0.3,))


def test_measure_manifold__never_in_Omega_Kd__no_entry():
    found = measure_manifold(made_rows(lambda t: 2.0 + 0.0 * t), 1.0)
    assert math.isnan(found.regions.entered_s[0])
    assert (found.regions.entries, found.regions.exits) == ((0.0,), (0.0,))
    assert found.decaying is None


def test_measure_manifold__monitors__means_over_decay_and_steady_state():
    rows = made_rows(lambda t: 2.0 * np.exp(-10.0 * t))
    rows["dissipation_W"], rows["demand_W"] = rows["t_ref_s"], 0.5
    rows["is_dissipating"] = rows["t_ref_s"] > 1.5
    found = measure_manifold(rows, 1.0)
    assert found.decaying is not None
    assert found.decaying.dissipation_W == pytest.approx(0.5 * math.log(10.0) / 10.0, abs=1e-3)
    assert found.decaying.share == 0.0
    assert found.steady.dissipation_W == pytest.approx(1.4995)
    assert found.steady.share == pytest.approx(0.499)
    assert math.isnan(found.steady.model_share)
    assert found.powers is None


def test_model_powers__one_link_turning_steadily__friction_of_dq_minus_S():
    rows = made_rows(lambda t: 0.4 + 0.0 * t)
    S = np.full((len(rows), 1), 0.4)
    dissipation, demand = model_powers(rows, S, HORIZONTAL)
    torque = 0.2 * 1.1 + 0.5 * math.tanh(50.0 * 1.1)
    assert dissipation == pytest.approx(2.0 * 0.4**2)
    assert demand == pytest.approx(0.4 * torque)


def test_model_powers__falling_S__inertia_times_change_of_dq_r():
    rows = made_rows(lambda t: 0.4 - 0.1 * t)
    S = 0.4 - 0.1 * rows["t_ref_s"][:, None]
    bare = LINK | {"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}
    _, demand = model_powers(rows, S, ModelSettings(links=[bare]))
    assert demand == pytest.approx(S[:, 0] * (0.02 + 1.0 * 0.1**2) * 0.1)


def test_plant_of__recorded_configuration__chain_and_friction_alone():
    plant = load_config(overrides={"arm": {"preset": "pelican_v"}}).model_dump(mode="json")
    found = plant_of(plant)
    assert found is not None
    assert (found.gravity_m_s2, found.links[1].mass_kg) == (9.81, 2.0458)
    assert plant_of({}) is None
    assert plant_of({"plant": {"gravity_m_s2": 9.81}}) is None


def test_has_monitors__earlier_recording__no():
    rows = made_rows(lambda t: t)
    assert has_monitors(rows)
    rows["in_Omega_Kd"] = np.nan
    assert not has_monitors(rows)


# --- the paper's claims on whole runs, closed form and simulation ---------------------------------


@pytest.mark.parametrize(("name", "exits"), [("A0", (0, 0)), ("A", (0, 0)), ("E", (2, 1))])
def test_measure_manifold__closed_form_scenarios__omega_kd_is_left_on_the_loaded_arm_alone(
    name, exits
):
    rows = run(find_scenario(name), duration_s=4.0)
    assert measure_manifold(rows, 3.0).regions.exits == exits


def played(name: str, duration_s: float):
    scenario = replace(find_scenario(name), duration_s=duration_s)
    config = load_config(overrides=scenario_settings(scenario))
    memory = Memory(config.joints)
    play_in_simulation(config, scenario_request(scenario), memory)
    return memory.samples(), config


@pytest.fixture(scope="module")
def scenario_a():
    """Three seconds of scenario A, from power-on to the end, and its configuration."""
    return played("A", 3.0)


def test_simulation__scenario_A__monitors_are_those_of_the_recorded_S(scenario_a):
    samples, _ = scenario_a
    rows = trajectory_rows(samples)
    S, Kd = rows["S_rad_s"], rows["Kd"]
    np.testing.assert_allclose(rows["V_rad2_s2"], 0.5 * (S**2).sum(axis=1), rtol=1e-13)
    np.testing.assert_allclose(rows["dissipation_W"], (Kd * S**2).sum(axis=1), rtol=1e-13)
    demand = np.abs((S * rows["tau_need_Nm"]).sum(axis=1))
    np.testing.assert_allclose(rows["demand_W"], demand, rtol=1e-12, atol=1e-15)
    is_dissipating = rows["dissipation_W"] > rows["demand_W"]
    assert rows["is_dissipating"].tolist() == is_dissipating.tolist()
    share = 1.0 - math.exp(-2.0 * math.pi * 5.0 * 1e-3)
    change = np.diff(rows["tau_need_Nm"], axis=0)
    behind = rows["tau_sent_Nm"][1:] - rows["tau_need_Nm"][:-1]
    np.testing.assert_allclose(change, share * behind, rtol=0.0, atol=1e-13)
    inside = np.abs(S) < 1.0
    assert np.array_equal(rows["in_Omega_Kd"], inside)
    entered = np.cumsum(np.diff(inside.astype(int), axis=0) > 0, axis=0)
    assert np.array_equal(np.diff(rows["Omega_Kd_entries"], axis=0).cumsum(axis=0), entered)


def test_simulation__before_power__monitors_are_zero(scenario_a):
    samples, _ = scenario_a
    idle = samples[samples["state"] == 1]
    assert len(idle) > 0
    for name in ("V_rad2_s2", "dissipation_W", "demand_W", "tau_need_Nm", "S_bound_rad_s"):
        assert not idle[: len(idle) // 2][name].any()


def test_simulation__scenario_A__36_holds_by_the_plant_while_S_decays(scenario_a):
    samples, config = scenario_a
    plant = plant_of(config.model_dump(mode="json"))
    found = measure_manifold(trajectory_rows(samples), 1.5, plant)
    assert found.decaying is not None
    assert found.decaying.model_share == 1.0
    assert found.steady.model_share < 1.0
    assert found.regions.exits == (0.0, 0.0)
    assert found.regions.entered_s == pytest.approx((0.016, 0.017), abs=2e-3)
    assert found.decay.rate_1_s == pytest.approx((10.5, 97.0), rel=0.1)


def test_simulation__clipped_gaussians__warned_of_in_an_event():
    events = []

    class Watching(Memory):
        def add_event(self, t_ns, cycle, kind, detail="{}"):
            events.append((kind, detail))

    scenario = replace(find_scenario("A"), duration_s=0.1)
    law = {"controller": {"law": {"membership": "gaussian_clipped"}}}
    play_in_simulation(load_config(overrides=law), scenario_request(scenario), Watching(2))
    warnings = [detail for kind, detail in events if kind == "warning"]
    assert len(warnings) == 1
    assert "use gaussian_normalised" in warnings[0]["detail"]
