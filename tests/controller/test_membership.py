"""The memberships against what the module says of each, and what fails where it says so."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.gain import SelfTuningGain
from controller.gain import memberships as gain_memberships
from controller.law import PassivityLaw
from controller.membership import MEMBERSHIPS, Degrees, sigmoid
from controller.player import Setpoint
from controller.settings import ControllerSettings, LawSettings

NAMES = list(MEMBERSHIPS)
PARTITIONS = ["sigmoid", "gaussian_normalised", "triangular"]
PAPER = (1.0, 2.0, 4.0)
S_MAX = 3.0
STEP = 1e-5
GRID = np.arange(0.0, S_MAX, STEP)
ANY_SIZE = st.floats(0.0, allow_nan=False, allow_infinity=False)
SIZE = st.floats(0.0, 1.5)
FALLING = st.lists(st.floats(0.1, 8.0), min_size=3, max_size=3).map(sorted)  # big, medium, small


def degrees(name: str, sizes=GRID) -> np.ndarray:
    return np.array([MEMBERSHIPS[name](float(size)) for size in sizes])


def gain(name: str, beta=PAPER, low: float = 1.0, high: float = 4.0) -> Callable[[float], float]:
    settings = LawSettings(
        membership=name, beta=tuple(beta), adaptation="off", Kd_min=(low,), Kd_max=(high,)
    )
    tuned = SelfTuningGain(settings, 0)
    return lambda S: tuned.step(S, 1e-3)


def torque(name: str, beta=PAPER) -> np.ndarray:
    """Kd(S) S over the grid, clipped to the box of the consequences as the gain is."""
    return np.clip(degrees(name) @ np.asarray(beta), min(beta), max(beta)) * GRID


def largest_fall(values: np.ndarray) -> tuple[float, float, float]:
    """How far values fall below an earlier one, relative to that; where it was, and where to."""
    falls = np.maximum.accumulate(values) - values
    end = int(falls.argmax())
    start = int(values[: end + 1].argmax())
    return falls[end] / values[start], GRID[start], GRID[end]


# --- every membership -------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
@given(size=ANY_SIZE | SIZE)
def test_membership__any_size__degrees_between_zero_and_one(name, size):
    assert all(0.0 <= degree <= 1.0 for degree in MEMBERSHIPS[name](size))


@pytest.mark.parametrize("name", NAMES)
def test_membership__over_a_grid__continuous(name):
    jumps = np.abs(np.diff(degrees(name, np.arange(0.0, 25.0, 1e-4)), axis=0))
    assert jumps.max() < 1e-4 * 7.0  # no slope is steeper than 1 / (4 * 0.04 rad/s) = 6.25 s/rad


@pytest.mark.parametrize(
    ("name", "at_0", "at_1"),
    [
        ("sigmoid", 3.980, 1.034),
        ("gaussian_normalised", 3.943, 1.012),
        ("triangular", 4.0, 1.0),
        ("gaussian_clipped", 4.0, 1.0),
    ],
)
def test_membership__paper_consequences__Kd_from_nearly_Kd_max_to_nearly_Kd_min(name, at_0, at_1):
    Kd = gain(name)
    assert Kd(0.0) == pytest.approx(at_0, abs=5e-4)
    assert Kd(1.0) == pytest.approx(at_1, abs=5e-4)
    assert Kd(-1.0) == Kd(1.0)


@pytest.mark.parametrize("name", NAMES)
@given(size=ANY_SIZE | SIZE, beta=FALLING)
def test_membership__any_size__gain_stays_in_its_box(name, size, beta):
    low, _, high = beta
    assert low <= gain(name, beta, low, high)(size) <= high


# --- partitions of unity ----------------------------------------------------------------------


@pytest.mark.parametrize("name", PARTITIONS)
@given(size=ANY_SIZE | SIZE)
def test_partition__any_size__sums_to_one(name, size):
    assert sum(MEMBERSHIPS[name](size)) == pytest.approx(1.0, abs=5e-16)


@given(size=SIZE)
def test_sigmoid__any_size__medium_needs_no_floor(size):
    """a >= b for every size >= 0: what the partition of unity rests on."""
    a = 1.0 / (1.0 + math.exp((0.20 - size) / 0.04))
    b = 1.0 / (1.0 + math.exp((0.60 - size) / 0.12))
    assert a >= b - 1e-17


@pytest.mark.parametrize("name", PARTITIONS)
@given(size=ANY_SIZE | SIZE, Kd=st.floats(0.1, 8.0))
def test_partition__equal_consequences__constant_gain(name, size, Kd):
    assert gain(name, (Kd,) * 3, 0.1, 8.0)(size) == pytest.approx(Kd, rel=1e-15)


@pytest.mark.parametrize("name", PARTITIONS)
@given(first=SIZE, second=SIZE, beta=FALLING)
def test_partition__any_falling_consequences__Kd_never_rises_with_size(name, first, second, beta):
    near, far = sorted((first, second))
    Kd = gain(name, beta, 0.1, 8.0)
    assert Kd(far) <= Kd(near) + 1e-14


@pytest.mark.parametrize("name", PARTITIONS)
def test_partition__far_away__the_consequence_of_big_alone(name):
    Kd = gain(name, (1.7, 2.0, 4.0))
    assert Kd(20.0) == Kd(1e300) == pytest.approx(1.7, abs=1e-15)


# --- Kd(S) S ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "least"), [("sigmoid", 0.0115), ("gaussian_normalised", 0.177)])
def test_smooth_partition__paper_consequences__torque_never_falls_with_size(name, least):
    """Over the whole axis: slope on a grid, less what it can change between two grid points.

    |d2(Kd S)/dS2| <= 2 |Kd'| + S |Kd''| stays below 400 Nms2/rad2 here; beyond the grid Kd has
    reached 1 within 1e-8 and its slope is below 1e-7.
    """
    slopes = np.diff(torque(name)) / STEP
    assert np.abs(np.diff(slopes)).max() / STEP < 400.0
    assert slopes.min() - 400.0 * STEP > 0.0
    assert slopes.min() == pytest.approx(least, abs=5e-4)


@pytest.mark.parametrize(
    ("name", "fall", "start", "end"),
    [("triangular", 1 / 16, 0.8, 1.0), ("gaussian_clipped", 0.123, 0.478, 0.857)],
)
def test_other_membership__paper_consequences__torque_falls_where_the_module_says(
    name, fall, start, end
):
    assert largest_fall(torque(name)) == pytest.approx((fall, start, end), abs=1e-3)


@pytest.mark.parametrize(("name", "most"), [("sigmoid", 4.03), ("gaussian_normalised", 4.65)])
def test_smooth_partition__consequences_further_apart__torque_falls_in_the_end(name, most):
    def consequences(ratio: float) -> tuple[float, float, float]:
        return 1.0, 1.0 + (ratio - 1.0) / 3.0, ratio

    assert np.diff(torque(name, consequences(most - 0.02))).min() >= 0.0
    assert np.diff(torque(name, consequences(most + 0.02))).min() < 0.0


# --- Gaussians that are not normalised ----------------------------------------------------------


def test_gaussian_clipped__plain_sum__leaves_the_bounds_on_both_sides():
    total = degrees("gaussian_clipped") @ np.asarray(PAPER)
    assert total.max() == pytest.approx(4.138, abs=1e-3)
    assert total.min() < 1e-30
    assert degrees("gaussian_clipped").sum(axis=1).max() == pytest.approx(1.1256, abs=1e-4)


def test_gaussian_clipped__paper_consequences__Kd_never_rises_within_the_box():
    Kd = gain("gaussian_clipped")
    assert np.diff([Kd(float(S)) for S in GRID[::10]]).max() <= 1e-15


@pytest.mark.parametrize("beta", [(2.0, 2.0, 2.0), (1.7, 2.0, 4.0)])
def test_gaussian_clipped__far_away__Kd_min_whatever_big_says(beta):
    assert gain("gaussian_clipped", beta)(2.0) == 1.0


def test_gaussian_clipped__equal_consequences__not_a_constant_gain():
    Kd = [gain("gaussian_clipped", (2.0, 2.0, 2.0))(S) for S in (0.2, 0.4, 0.6)]
    assert Kd == pytest.approx([2.006, 2.251, 2.006], abs=1e-3)
    assert max(np.diff(Kd)) > 0.2  # it rises, though no consequence does


# --- selection ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", NAMES)
def test_law__membership_by_name__acts_in_the_gain(name):
    law = PassivityLaw(LawSettings(membership=name, adaptation="off"), (1e9, 1e9))
    zeros = [0.0, 0.0]
    law.step(zeros, [0.3, -0.7], Setpoint(zeros, zeros, zeros), 1e-3)
    by_hand = [np.clip(np.dot(PAPER, MEMBERSHIPS[name](size)), 1.0, 4.0) for size in (0.3, 0.7)]
    assert law.Kd == pytest.approx(by_hand, rel=1e-14)


def test_law__no_membership_named__sigmoid():
    assert LawSettings().membership == "sigmoid"
    assert gain_memberships is sigmoid
    assert set(NAMES) == set(LawSettings.model_fields["membership"].annotation.__args__)


def controller(**law) -> ControllerSettings:
    names = ("q_max_rad", "dq_max_rad_s", "dq_trip_rad_s", "ddq_max_rad_s2", "dddq_max_rad_s3")
    names += ("tau_max_Nm", "tau_slew_Nm_s", "following_error_rad", "damping_Nms_rad")
    limits = dict.fromkeys(names, (1.0, 1.0)) | {"q_min_rad": (-1.0, -1.0)}
    return ControllerSettings(law=law, limits=limits)


@pytest.mark.parametrize("name", NAMES)
def test_warnings__clipped_gaussians_alone__warned_of(name):
    warned = controller(membership=name).warnings()
    assert [w.split(":")[0] for w in warned] == (
        ["controller.law.membership gaussian_clipped"] if name == "gaussian_clipped" else []
    )


@pytest.mark.parametrize("law", [{"name": "pid"}, {"tuner": "load_memory"}])
def test_warnings__membership_without_effect__none(law):
    assert controller(membership="gaussian_clipped", **law).warnings() == []


def test_degrees__order__big_medium_small():
    expected: Degrees = (0.0, 0.0, 1.0)
    assert MEMBERSHIPS["triangular"](0.0) == expected
    assert all(f(0.0)[2] > 0.95 and f(0.9)[0] > 0.8 for f in MEMBERSHIPS.values())
