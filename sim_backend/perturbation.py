"""What may be wrong with an arm: plant settings made from plant settings, for comparisons.

Pure functions; each returns settings that are validated like those from a file.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal

from sim_backend.settings import LinkSettings, PlantSettings


def scaled(
    plant: PlantSettings, *, friction: float = 1.0, inertia: float = 1.0, gravity: float = 1.0
) -> PlantSettings:
    """Return the arm with quantities multiplied at every joint and link.

    Args:
        plant: The arm as it is.
        friction: Of viscous, Coulomb and static friction, rotors included.
        inertia: Of masses and moments of inertia, rotors included.
        gravity: Of the gravitational acceleration.
    """
    factors = {
        "viscous_Nms_rad": friction,
        "coulomb_Nm": friction,
        "static_Nm": friction,
        "mass_kg": inertia,
        "inertia_kg_m2": inertia,
        "rotor_inertia_kg_m2": inertia,
    }
    changed = _with_links(plant, lambda link: _multiplied(link.model_dump(), factors))
    return _with(changed, gravity_m_s2=gravity * plant.gravity_m_s2)


def with_payload(plant: PlantSettings, share: float, **times: object) -> PlantSettings:
    """Return the arm with an object at its tip, from the start unless `times` says otherwise.

    Args:
        plant: The arm as it is.
        share: Mass of the object as a share of the last link's: 0.5 for "payload +50 %".
        times: More fields of `PayloadSettings`: `pick_s`, `drop_s`, `is_at_rest`, `inertia_kg_m2`.
    """
    payload = {"mass_kg": share * plant.links[-1].mass_kg, **times}
    return _with(plant, payloads=[*plant.model_dump()["payloads"], payload])


def with_load_step(
    plant: PlantSettings, joint: int, torque_Nm: float, start_s: float, end_s: float | None = None
) -> PlantSettings:
    """Return the arm with a constant disturbance torque on a joint (1 is the shoulder)."""
    step = {"joint": joint, "torque_Nm": torque_Nm, "start_s": start_s, "end_s": end_s}
    return _with(plant, disturbances=[*plant.model_dump()["disturbances"], step])


def with_stribeck(
    plant: PlantSettings, ratio: float = 2.0, stribeck_rad_s: float = 0.1
) -> PlantSettings:
    """Return the arm with static friction a multiple of its Coulomb friction, where it has any."""

    def change(link: LinkSettings) -> dict[str, Any]:
        return {
            "static_Nm": ratio * link.coulomb_Nm or None,
            "stribeck_rad_s": stribeck_rad_s,
        }

    return _with_links(plant, change)


def with_backlash(
    plant: PlantSettings,
    gap_rad: float,
    encoder: Literal["motor", "link"] = "motor",
    rotor_inertia_kg_m2: float = 0.005,
) -> PlantSettings:
    """Return the arm with a rotor behind a gap at every joint.

    The rotors come on top of the links' inertia. Under a gain Kd sampled with period T a rotor in
    its gap needs more than Kd T / 2: 0.002 kg m^2 for Kd = 4 Nms/rad at 1 ms.
    """
    gear = {
        "gap_rad": gap_rad,
        "encoder": encoder,
        "rotor_inertia_kg_m2": rotor_inertia_kg_m2,
    }
    return _with_links(plant, lambda _: {"drivetrain": gear})


def _with(plant: PlantSettings, **changes: object) -> PlantSettings:
    return PlantSettings.model_validate({**plant.model_dump(), **changes})


def _with_links(
    plant: PlantSettings, change: Callable[[LinkSettings], Mapping[str, Any]]
) -> PlantSettings:
    return _with(plant, links=[{**link.model_dump(), **change(link)} for link in plant.links])


def _multiplied(table: Mapping[str, Any], factors: Mapping[str, float]) -> dict[str, Any]:
    """Return a copy in which the values named by `factors` are multiplied, in subtables too."""
    changed = dict(table)
    for key, value in table.items():
        if isinstance(value, Mapping):
            changed[key] = _multiplied(value, factors)
        elif value is not None:
            changed[key] = value * factors[key] if key in factors else value
    return changed
