"""The monitors against the paper's definitions, written out plainly."""

import gc
import sys
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.monitor import Monitor
from controller.settings import MonitorSettings

T = 1e-3
NUMBERS = st.floats(-3.0, 3.0)
CUTOFF_HZ = 5.0


def run(S, Kd=None, tau=None, dt_s=T, **settings) -> tuple[Monitor, list[dict]]:
    """Step a monitor through rows of S; return it and what it showed after every row."""
    S = np.atleast_2d(np.asarray(S, dtype=float))
    Kd = np.full_like(S, 2.0) if Kd is None else Kd
    tau = -Kd * S if tau is None else tau
    monitor = Monitor(MonitorSettings(**settings), S.shape[1])
    shown = []
    names = [name for name in Monitor.__slots__ if not name.startswith("_")]
    for row in zip(S.tolist(), Kd.tolist(), tau.tolist(), strict=True):
        monitor.step(*row, dt_s)
        values = {name: getattr(monitor, name) for name in names}
        shown.append({k: list(v) if isinstance(v, list) else v for k, v in values.items()})
    return monitor, shown


def signals(cycles=3000, joints=3, seed=1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    walk = np.cumsum(random.normal(0.0, 0.05, (cycles, joints)), axis=0)
    return walk, random.uniform(1.0, 4.0, walk.shape), random.normal(0.0, 3.0, walk.shape)


def test_monitor__random_run__storage_dissipation_and_demand_as_defined():
    S, Kd, tau = signals()
    _, shown = run(S, Kd, tau)
    share = 1.0 - np.exp(-2.0 * np.pi * CUTOFF_HZ * T)
    need = np.zeros(S.shape[1])
    for s, k, t, found in zip(S, Kd, tau, shown, strict=True):
        need = need + share * (t - need)
        assert found["V_rad2_s2"] == pytest.approx(0.5 * s @ s, rel=1e-12)
        assert found["dissipation_W"] == pytest.approx(s @ np.diag(k) @ s, rel=1e-12)
        assert found["demand_W"] == pytest.approx(abs(s @ need), abs=1e-12)
        np.testing.assert_allclose(found["tau_need_Nm"], need, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("joints", [1, 2, 7])
def test_monitor__random_run__regions_counted_at_every_crossing(joints):
    S, _, _ = signals(joints=joints, seed=joints)
    _, shown = run(S)
    inside = np.abs(S) < 1.0
    entered = np.cumsum(inside[1:] & ~inside[:-1], axis=0)
    left = np.cumsum(~inside[1:] & inside[:-1], axis=0)
    assert entered[-1].max() >= 2
    assert [row["in_Omega_Kd"] for row in shown] == (inside * 1.0).tolist()
    assert [row["entries"] for row in shown[1:]] == entered.tolist()
    assert [row["exits"] for row in shown[1:]] == left.tolist()


@pytest.mark.parametrize(("first", "inside"), [(0.999, 1.0), (1.0, 0.0), (-1.0, 0.0), (-0.5, 1.0)])
def test_monitor__first_step__region_noted_and_nothing_counted(first, inside):
    monitor, _ = run([[first]])
    assert (monitor.in_Omega_Kd, monitor.entries, monitor.exits) == ([inside], [0.0], [0.0])


def test_monitor__random_run__bound_is_the_largest_of_the_trailing_window():
    S, _, _ = signals(cycles=1500)
    _, shown = run(S, window_s=0.5)
    size = np.abs(S)
    for k, row in enumerate(shown):
        least = size[max(0, k - 449) : k + 1].max(axis=0)
        most = size[max(0, k - 500) : k + 1].max(axis=0)
        assert np.all(least <= row["S_bound_rad_s"])
        assert np.all(row["S_bound_rad_s"] <= most)
    bounds = [row["S_bound_rad_s"][0] for row in shown]
    assert any(later < earlier for earlier, later in pairwise(bounds))


def test_monitor__steady_load__both_sides_of_36_become_equal():
    """tau = -Kd S carries a constant load: S'Kd S = |S' Y_r Theta| at the ultimate bound."""
    monitor, _ = run(np.full((3000, 2), [0.05, -0.3]), Kd=np.full((3000, 2), [4.0, 1.5]))
    assert monitor.tau_need_Nm == pytest.approx([-0.2, 0.45])
    assert monitor.demand_W == pytest.approx(monitor.dissipation_W, rel=1e-12)


def test_monitor__noise_without_mean__dissipates_and_demands_little():
    noise = 0.2 * np.random.default_rng(2).choice([-1.0, 1.0], (4000, 2))
    _, shown = run(noise)
    dissipation = np.mean([row["dissipation_W"] for row in shown])
    demand = np.mean([row["demand_W"] for row in shown])
    assert dissipation == pytest.approx(2 * 2.0 * 0.04)
    assert demand < 0.2 * dissipation


def test_monitor__skipped_periods__filter_and_window_go_by_time():
    tau, S = np.full((40, 1), 1.0), np.zeros((40, 1))
    slow, _ = run(S[:20], tau=tau[:20], dt_s=2 * T)
    quick, _ = run(S, tau=tau)
    assert slow.tau_need_Nm == pytest.approx(quick.tau_need_Nm, rel=1e-12)
    decayed = [*[[2.0]] * 10, *[[0.1]] * 110]
    assert run(decayed, dt_s=T, window_s=0.2)[0].S_bound_rad_s == [2.0]
    assert run(decayed, dt_s=2 * T, window_s=0.2)[0].S_bound_rad_s == [0.1]


def test_monitor__reset__as_new():
    S, Kd, tau = signals(cycles=700)
    monitor, _ = run(S, Kd, tau)
    assert max(monitor.entries) > 0
    monitor.reset()
    fresh = Monitor(MonitorSettings(), 3)
    rows = list(zip(S[::-1].tolist(), Kd.tolist(), tau.tolist(), strict=True))
    for row in rows:
        monitor.step(*row, T)
        fresh.step(*row, T)
    for name in (name for name in Monitor.__slots__ if not name.startswith("_")):
        assert getattr(monitor, name) == getattr(fresh, name), name


@given(S=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=60))
def test_monitor__any_run__what_must_hold_holds(S):
    monitor, shown = run(S)
    for row in shown:
        assert row["V_rad2_s2"] >= 0.0
        assert row["dissipation_W"] >= 2.0 * row["V_rad2_s2"]  # Kd >= 1
        assert row["demand_W"] >= 0.0
    for j, (entered, left) in enumerate(zip(monitor.entries, monitor.exits, strict=True)):
        assert abs(entered - left) <= 1
        assert monitor.S_bound_rad_s[j] >= abs(S[-1][j])


@given(S=st.lists(st.tuples(NUMBERS, NUMBERS), min_size=1, max_size=60))
def test_monitor__mirrored_run__same_figures(S):
    there, back = run(S)[0], run(-np.array(S))[0]
    for name in ("V_rad2_s2", "dissipation_W", "demand_W", "entries", "exits", "S_bound_rad_s"):
        assert getattr(there, name) == getattr(back, name)
    assert there.tau_need_Nm == [-need for need in back.tau_need_Nm]


def test_monitor__many_steps__no_memory_gained():
    S, Kd, tau = signals(cycles=500, joints=2)
    rows = list(zip(S.tolist(), Kd.tolist(), tau.tolist(), strict=True))
    monitor = Monitor(MonitorSettings(window_s=0.05), 2)

    def play(turns: int) -> int:
        for _ in range(turns):
            for row in rows:
                monitor.step(*row, T)
        gc.collect()
        return sys.getallocatedblocks()

    before = play(4)
    assert play(40) - before < 50
