"""Settings of the controller: what is refused, and that the message names setting and joint."""

import pytest
from pydantic import ValidationError

from controller.settings import ControllerSettings, LawSettings, LimitSettings, VelocitySettings

LIMITS = {
    "q_min_rad": (-1.0, -1.5),
    "q_max_rad": (2.0, 2.5),
    "dq_max_rad_s": (3.0, 4.0),
    "dq_trip_rad_s": (5.0, 6.0),
    "ddq_max_rad_s2": (60.0, 70.0),
    "dddq_max_rad_s3": (2000.0, 3000.0),
    "tau_max_Nm": (15.0, 8.0),
    "tau_slew_Nm_s": (1000.0, 500.0),
    "following_error_rad": (0.5, 0.6),
    "damping_Nms_rad": (1.0, 1.1),
}
LAW_LISTS = ("alpha", "lambda_", "Ki", "Kd", "Kd_min", "Kd_max")
POSITIVE = [name for name in LIMITS if name not in ("q_min_rad", "q_max_rad", "damping_Nms_rad")]


def controller(*, law=None, velocity=None, limits=None):
    return ControllerSettings(
        law=LawSettings(**law or {}),
        velocity=VelocitySettings(**velocity or {}),
        limits=LimitSettings(**LIMITS | (limits or {})),
    )


def test_defaults__are_the_settled_readings():
    law, velocity = LawSettings(), VelocitySettings()
    assert (law.name, law.manifold, law.adaptation) == ("self_tuning_pid", "tanh", "literal")
    assert (law.alpha, law.lambda_, law.Ki) == ((5.0, 7.5), (10.0, 10.0), (0.2, 0.2))
    assert (law.Kd_min, law.Kd_max, law.beta) == ((1.0, 1.0), (4.0, 4.0), (1.0, 2.0, 4.0))
    assert law.learning_rate == 1e-6
    assert (velocity.estimator, velocity.cutoff_Hz) == ("filtered_difference", 30.0)
    assert velocity.C_rad_s2 == (50.0, 100.0)


def test_require_joints__as_many_entries_as_joints__accepted():
    controller(velocity={"estimator": "levant"}).require_joints(2)


@pytest.mark.parametrize("name", [name for name in LAW_LISTS if not name.startswith("Kd_")])
def test_require_joints__a_list_of_the_law_too_short__named_with_both_numbers(name):
    with pytest.raises(ValueError, match=f"{name} has 1 entries, the arm has 2 joints"):
        controller(law={name: (1.0,)}).require_joints(2)


@pytest.mark.parametrize("name", ["Kd_min", "Kd_max"])
def test_require_joints__a_gain_bound_too_short__named_with_both_numbers(name):
    with pytest.raises(ValueError, match=f"{name} has 1 entries, the arm has 2 joints"):
        controller(law={name: (2.0,)}).require_joints(2)


@pytest.mark.parametrize("name", list(LIMITS))
def test_require_joints__a_list_of_the_limits_too_long__named_with_both_numbers(name):
    longer = (*LIMITS[name], LIMITS[name][-1])
    with pytest.raises(ValueError, match=f"{name} has 3 entries, the arm has 2 joints"):
        controller(limits={name: longer}).require_joints(2)


def test_require_joints__levant__needs_a_C_per_joint():
    settings = controller(velocity={"estimator": "levant", "C_rad_s2": (50.0,)})
    with pytest.raises(ValueError, match="C_rad_s2 has 1 entries"):
        settings.require_joints(2)
    controller(velocity={"C_rad_s2": (50.0,)}).require_joints(2)  # nobody looks at it


def test_require_joints__every_per_joint_list_of_the_limits__is_checked():
    lists = {n for n, f in LimitSettings.model_fields.items() if "tuple" in str(f.annotation)}
    assert lists == set(LIMITS)


@pytest.mark.parametrize(
    ("low", "high"),
    [((1.0, 0.05), (4.0, 4.0)), ((1.0, 1.0), (4.0, 8.5)), ((1.0, 3.0), (4.0, 2.0))],
    ids=["below the floor", "above the ceiling", "crossed"],
)
def test_law__gain_bounds_out_of_order__refused_with_the_joint(low, high):
    with pytest.raises(
        ValidationError, match=r"joint 2: gain bounds .* Kd_floor 0.1 and Kd_ceiling 8"
    ):
        LawSettings(Kd_min=low, Kd_max=high)


@pytest.mark.parametrize(
    "wrong",
    [
        {"name": "pidd"},
        {"manifold": "relu"},
        {"adaptation": "on"},
        {"learning_rate": -1e-6},
        {"Kd_ramp_per_s": 0.0},
        {"alpha": (float("nan"), 1.0)},
        {"alpha": (float("inf"), 1.0)},
        {"beta": (1.0, 2.0)},
        {"alfa": (5.0, 7.5)},
    ],
    ids=str,
)
def test_law__impossible_setting__refused(wrong):
    with pytest.raises(ValidationError):
        LawSettings(**wrong)


@pytest.mark.parametrize(
    "wrong", [{"cutoff_Hz": 0.0}, {"lock_tolerance_rad": 0.0}, {"estimator": "kalman"}], ids=str
)
def test_velocity__impossible_setting__refused(wrong):
    with pytest.raises(ValidationError):
        VelocitySettings(**wrong)


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("name", ["alpha", "lambda_", "Kd"])
def test_law__not_above_zero__refused_with_setting_and_joint(name, value):
    """A negative gain drives the arm away from its reference."""
    with pytest.raises(ValidationError, match=f"joint 2: {name} {value:g} must be above 0"):
        LawSettings(**{name: (4.0, value)})


def test_law__negative_Ki__refused_and_zero_accepted():
    with pytest.raises(ValidationError, match=r"joint 1: Ki -0.2 must not be below 0"):
        LawSettings(Ki=(-0.2, 0.2))
    assert LawSettings(Ki=(0.0, 0.2)).Ki == (0.0, 0.2)


@pytest.mark.parametrize("value", [0.0, -50.0])
def test_velocity__C_not_above_zero__refused_with_the_joint(value):
    with pytest.raises(ValidationError, match=f"joint 2: C_rad_s2 {value:g} must be above 0"):
        VelocitySettings(C_rad_s2=(50.0, value))


@pytest.mark.parametrize("value", [0.0, -1.0])
@pytest.mark.parametrize("name", POSITIVE)
def test_limits__not_above_zero__refused_with_setting_and_joint(name, value):
    """A negative torque limit would turn "clip to +-tau_max" into a constant torque."""
    with pytest.raises(ValidationError, match=f"joint 2: {name} {value:g} must be above 0"):
        LimitSettings(**{**LIMITS, name: (LIMITS[name][0], value)})


def test_limits__negative_damping__refused():
    with pytest.raises(ValidationError, match="joint 1: damping_Nms_rad -1 must not be below 0"):
        LimitSettings(**{**LIMITS, "damping_Nms_rad": (-1.0, 1.0)})


@pytest.mark.parametrize("low", [2.5, 3.0])
def test_limits__empty_position_range__refused_with_the_joint(low):
    with pytest.raises(ValidationError, match=r"joint 2: q_min_rad .* must be below q_max_rad 2.5"):
        LimitSettings(**{**LIMITS, "q_min_rad": (-1.0, low)})


@pytest.mark.parametrize(
    "wrong",
    [{"hard_margin_rad": 0.0}, {"n_hold": -1}, {"n_damp": -1}, {"stop_timeout_s": 0.0}],
    ids=str,
)
def test_limits__impossible_setting__refused(wrong):
    with pytest.raises(ValidationError):
        LimitSettings(**{**LIMITS, **wrong})


def test_settings__once_made__cannot_be_changed():
    with pytest.raises(ValidationError, match="frozen"):
        LawSettings().name = "pd"
