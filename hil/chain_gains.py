"""Gains and limits that fit the synthetic chains (`sim_backend.presets`), joint by joint.

What a gain does depends on the inertia it works on. A chain's links get lighter towards its tip,
so a gain there has to be smaller by as much; the same number on every joint would shake the tip.
"""

from typing import Any

from sim_backend.settings import LinkSettings, PlantSettings

GAIN_MAX_PER_S = 60.0
"""Kd_max over the link's own inertia about its joint. The rates at which S decays, eigenvalues of
inv(M) Kd, lie between 0.05 and 3.2 times this (12 joints, any pose), where the bench arm with its
default gains has 20 to 225 1/s."""
GAIN_MIN_SHARE = 0.25
DAMPING_PER_S = 20.0
"""The same of the damped stop."""
ALPHA_PER_S = 4.0
C_RAD_S2 = 100.0
KD_FLOOR = 1e-3


def chain_controller(plant: PlantSettings) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the tables `controller.law` and `controller.limits`, as far as they differ.

    Args:
        plant: The chain.
    """
    inertias = [_own_inertia_kg_m2(link) for link in plant.links]
    n = len(inertias)
    Kd_max = [round(GAIN_MAX_PER_S * inertia, 6) for inertia in inertias]
    law = {
        "alpha": [ALPHA_PER_S] * n,
        "lambda_": [10.0] * n,
        "Ki": [0.2] * n,
        "Kd": Kd_max,
        "Kd_min": [round(GAIN_MIN_SHARE * Kd, 6) for Kd in Kd_max],
        "Kd_max": Kd_max,
        "Kd_floor": KD_FLOOR,
    }
    limits = {"damping_Nms_rad": [round(DAMPING_PER_S * inertia, 6) for inertia in inertias]}
    return law, limits


def _own_inertia_kg_m2(link: LinkSettings) -> float:
    return link.inertia_kg_m2 + link.mass_kg * link.com_m**2
