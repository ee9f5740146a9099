"""Arms that come with the product, and amplifiers that fit them.

`bench` and `light` are synthetic; `pelican` is the arm of Kelly, Santibanez and Loria, "Control
of Robot Manipulators in Joint Space", ch. 5, with friction and torque limits assumed. `chain_h:N`
is a synthetic arm of N joints for questions of scale: each link is lighter than the one before by
the same factor, so that joints far out neither vanish nor rule the shoulder.
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
"""Every preset of two joints: arm, then `_h` (horizontal, as without suffix) or `_v` (vertical)."""

CHAIN = "chain_h:"
"""Prefix of the presets with any number of joints; the number follows."""
CHAIN_JOINTS_MAX = 12
CHAIN_TAPER = 0.6
"""Every mass, inertia, friction and torque of a chain's link over that of the link before."""
_CHAIN_SHOULDER = LinkSettings(
    length_m=0.08, com_m=0.02, mass_kg=1.0, inertia_kg_m2=0.1, viscous_Nms_rad=0.05, coulomb_Nm=0.05
)
_CHAIN_TORQUE_MAX_NM = 20.0
_CHAIN_POSE_RAD = (0.3, -0.2)
_TAPERED = ("mass_kg", "inertia_kg_m2", "viscous_Nms_rad", "coulomb_Nm")


def plant_preset(name: str, q0_rad: Sequence[float] | None = None) -> PlantSettings:
    """Return the arm called `name`, at rest at `q0_rad`.

    Left out, that is hanging straight down, and for a chain slightly bent to and fro.

    Raises:
        SimError: If there is no such preset; the message lists those there are.

    Example:
        >>> plant_preset("pelican_v").gravity_m_s2
        9.81
    """
    if is_chain(name):
        return _chain_plant(chain_joints(name), q0_rad)
    arm, plane = _split(name)
    links = tuple(LinkSettings(**dict(zip(_FIELDS, row, strict=True))) for row in _LINKS[arm])
    return PlantSettings(
        links=links, gravity_m_s2=_GRAVITY[plane], q0_rad=tuple(q0_rad or (0.0, 0.0))
    )


def servo_preset(name: str) -> tuple[ServoSettings, ...]:
    """Return motor, current loop and encoder of each joint of the arm called `name`.

    Raises:
        SimError: If there is no such preset; the message lists those there are.
    """
    if is_chain(name):
        joints = range(chain_joints(name))
        peaks_Nm = tuple(round(_CHAIN_TORQUE_MAX_NM * CHAIN_TAPER**j, 3) for j in joints)
    else:
        peaks_Nm = _TORQUE_MAX_NM[_split(name)[0]]
    return tuple(
        ServoSettings(
            torque_constant_Nm_A=torque_max_Nm / CURRENT_PEAK_A, current_max_A=CURRENT_PEAK_A
        )
        for torque_max_Nm in peaks_Nm
    )


def is_chain(name: str) -> bool:
    """Tell whether a preset's name asks for a chain."""
    return name.startswith(CHAIN)


def chain_joints(name: str) -> int:
    """Return how many joints the chain called `name` has.

    Raises:
        SimError: If that is no number from 1 to `CHAIN_JOINTS_MAX`.
    """
    number = name.removeprefix(CHAIN)
    is_number = number.isascii() and number.isdigit()
    if not is_number or not 1 <= int(number) <= CHAIN_JOINTS_MAX:
        raise SimError(
            f"arm preset {name!r}: a chain has 1 to {CHAIN_JOINTS_MAX} joints, e.g. {CHAIN}7"
        )
    return int(number)


def _chain_plant(joints: int, q0_rad: Sequence[float] | None) -> PlantSettings:
    first = _CHAIN_SHOULDER
    links = tuple(
        first.model_copy(
            update={key: getattr(first, key) * CHAIN_TAPER**number for key in _TAPERED}
        )
        for number in range(joints)
    )
    pose = tuple(q0_rad or (_CHAIN_POSE_RAD[number % 2] for number in range(joints)))
    return PlantSettings(links=links, q0_rad=pose)


def _split(name: str) -> tuple[str, str]:
    """Split a preset's name into (arm, suffix)."""
    if name not in PRESETS:
        raise SimError(
            f"no arm preset {name!r}; there are: {', '.join(PRESETS)}, and {CHAIN}N with N joints"
        )
    arm, underscore, plane = name.partition("_")
    return arm, underscore + plane
