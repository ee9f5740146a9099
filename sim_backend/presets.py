"""Arms that come with the product, and amplifiers that fit them.

`bench` and `light` are synthetic; `pelican` is the arm of Kelly, Santibanez and Loria, "Control
of Robot Manipulators in Joint Space", ch. 5, with friction and torque limits assumed.
"""

from collections.abc import Sequence

from sim_backend.errors import SimError
from sim_backend.settings import LinkSettings, PlantSettings, ServoSettings

GRAVITY_M_S2 = 9.81
CURRENT_PEAK_A = 10.0

_FIELDS = ("length_m", "com_m", "mass_kg", "inertia_kg_m2", "viscous_Nms_rad", "coulomb_Nm")
_LINKS = {
    "bench": ((0.25, 0.10, 2.0, 0.030, 0.05, 0.05), (0.25, 0.10, 0.8, 0.032, 0.01, 0.01)),
    "pelican": (
        (0.26, 0.0983, 6.5225, 0.1213, 0.10, 0.20),
        (0.26, 0.0229, 2.0458, 0.0116, 0.01, 0.02),
    ),
    "light": ((0.20, 0.08, 0.8, 0.008, 0.02, 0.03), (0.20, 0.08, 0.35, 0.004, 0.004, 0.008)),
}
_TORQUE_MAX_NM = {"bench": (15.0, 8.0), "pelican": (25.0, 5.0), "light": (8.0, 4.0)}
_GRAVITY = {"": 0.0, "_h": 0.0, "_v": GRAVITY_M_S2}

PRESETS = tuple(arm + plane for arm in _LINKS for plane in _GRAVITY)
"""Every preset name: the arm, then `_h` (horizontal, as without suffix) or `_v` (vertical)."""


def plant_preset(name: str, q0_rad: Sequence[float] = (0.0, 0.0)) -> PlantSettings:
    """Return the arm called `name`, at rest at `q0_rad` (default: hanging straight down).

    Raises:
        SimError: If there is no such preset; the message lists those there are.

    Example:
        >>> plant_preset("pelican_v").gravity_m_s2
        9.81
    """
    arm, plane = _split(name)
    links = tuple(LinkSettings(**dict(zip(_FIELDS, row, strict=True))) for row in _LINKS[arm])
    return PlantSettings(links=links, gravity_m_s2=_GRAVITY[plane], q0_rad=tuple(q0_rad))


def servo_preset(name: str) -> tuple[ServoSettings, ...]:
    """Return motor, current loop and encoder of each joint of the arm called `name`.

    Raises:
        SimError: If there is no such preset; the message lists those there are.
    """
    arm, _ = _split(name)
    return tuple(
        ServoSettings(
            torque_constant_Nm_A=torque_max_Nm / CURRENT_PEAK_A, current_max_A=CURRENT_PEAK_A
        )
        for torque_max_Nm in _TORQUE_MAX_NM[arm]
    )


def _split(name: str) -> tuple[str, str]:
    """Split a preset's name into (arm, suffix)."""
    if name not in PRESETS:
        raise SimError(f"no arm preset {name!r}; there are: {', '.join(PRESETS)}")
    arm, underscore, plane = name.partition("_")
    return arm, underscore + plane
