"""Settings of the plant: from TOML, with clear refusals, everything off by default."""

import tomllib

import pytest
from pydantic import ValidationError

from sim_backend.arm import Arm
from sim_backend.presets import PRESETS, plant_preset
from sim_backend.settings import PlantSettings

FULL = """
gravity_m_s2 = 9.81
q0_rad = [0.1, 0.2]

[[links]]
length_m = 0.25
com_m = 0.1
mass_kg = 2.0
inertia_kg_m2 = 0.03
coulomb_Nm = 0.05
static_Nm = 0.08
stribeck_rad_s = 0.2
q_min_rad = -2.0
q_max_rad = 2.0

[links.drivetrain]
rotor_inertia_kg_m2 = 0.005
gap_rad = 0.01
encoder = "link"

[[links]]
length_m = 0.25
com_m = 0.1
mass_kg = 0.8
inertia_kg_m2 = 0.032

[[disturbances]]
joint = 1
torque_Nm = 0.3
start_s = 5.0

[[disturbances]]
joint = 2
kind = "sine"
torque_Nm = 0.1
frequency_Hz = 2.0
start_s = 1.0
end_s = 3.0

[[payloads]]
mass_kg = 0.4
inertia_kg_m2 = 0.001
pick_s = 2.0
drop_s = 4.0
is_at_rest = true
"""


def table() -> dict:
    return tomllib.loads(FULL)


def test_plant__everything_from_toml__is_read_and_runs():
    settings = PlantSettings.model_validate(table())
    assert settings.links[0].drivetrain.encoder == "link"
    assert settings.links[0].static_Nm == 0.08
    assert settings.links[1].drivetrain is None
    assert settings.disturbances[1].frequency_Hz == 2.0
    assert settings.payloads[0].is_at_rest
    assert PlantSettings.model_validate_json(settings.model_dump_json()) == settings
    Arm(settings).step((0.1, 0.1), 0.01)


@pytest.mark.parametrize("name", PRESETS)
def test_plant__preset__has_every_option_off(name):
    settings = plant_preset(name)
    assert (settings.disturbances, settings.payloads) == ((), ())
    for link in settings.links:
        options = (link.static_Nm, link.q_min_rad, link.q_max_rad, link.drivetrain)
        assert options == (None,) * 4
    arm = Arm(settings)
    assert arm._advance == arm._advance_two


def put(path: str, value: object) -> dict:
    """Return the full table with one value replaced."""
    settings = table()
    *way, last = path.split(".")
    at = settings
    for part in way:
        at = at[int(part)] if part.isdigit() else at[part]
    at[last] = value
    return settings


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        ("links.0.static_Nm", 0.04, r"static_Nm = 0\.04 is below coulomb_Nm = 0\.05"),
        ("links.0.q_min_rad", 2.5, r"q_min_rad = 2\.5 must be below q_max_rad = 2"),
        ("q0_rad", [2.1, 0.0], r"q0_rad of joint 1 is 2\.1, outside its stops"),
        ("disturbances.0.joint", 3, "disturbance 1 acts on joint 3: this arm has 2"),
        ("disturbances.0.joint", 0, "greater than or equal to 1"),
        ("disturbances.0.frequency_Hz", 1.0, "a constant disturbance has no frequency_Hz"),
        ("disturbances.1.frequency_Hz", None, "a sine disturbance needs frequency_Hz"),
        ("disturbances.1.end_s", 0.5, r"end_s = 0\.5 s must be later than start_s = 1 s"),
        ("payloads.0.drop_s", 2.0, "drop_s = 2 s must be later than pick_s = 2 s"),
        ("payloads.0.mass_kg", 0.0, "greater than 0"),
        ("links.0.drivetrain.gap_rad", -0.1, "greater than or equal to 0"),
        ("links.0.drivetrain.encoder", "tip", "'motor' or 'link'"),
        ("links.0.drivetrain.backlash", 0.1, "not permitted"),
    ],
)
def test_plant__contradiction__is_refused_with_the_figures(path, value, message):
    with pytest.raises(ValidationError, match=message):
        PlantSettings.model_validate(put(path, value))
