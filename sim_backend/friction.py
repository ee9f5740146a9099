"""Friction of a joint or rotor as a function of its rate."""

from collections.abc import Callable
from math import e, exp, sqrt, tanh

from sim_backend.errors import SimError
from sim_backend.settings import DrivetrainSettings, LinkSettings

Friction = Callable[[float], float]
"""From a rate in rad/s to the torque in Nm that opposes it (same sign as the rate)."""

_STEEPEST_FALL = sqrt(2.0 / e)  # of exp(-x^2), at x = 1/sqrt(2)


def has_stribeck(link: LinkSettings) -> bool:
    """True if the friction torque of this joint falls as it begins to move."""
    return link.static_Nm is not None and link.static_Nm > link.coulomb_Nm


def make_friction(source: LinkSettings | DrivetrainSettings, slope_s_rad: float) -> Friction:
    """Return `B dq + [C + (Cs - C) exp(-(dq / vs)^2)] tanh(D dq)`.

    Without static friction that is the friction of the paper's eq. (1); the Stribeck effect is
    named in its section 6.3.

    Args:
        source: Its viscous, Coulomb and static friction; a rotor has no static one.
        slope_s_rad: D.
    """
    viscous, coulomb = source.viscous_Nms_rad, source.coulomb_Nm
    if isinstance(source, DrivetrainSettings) or source.static_Nm is None:
        return lambda rate: viscous * rate + coulomb * tanh(slope_s_rad * rate)
    excess, per_vs = source.static_Nm - coulomb, 1.0 / source.stribeck_rad_s

    def stribeck(rate: float) -> float:
        x = rate * per_vs
        return viscous * rate + (coulomb + excess * exp(-x * x)) * tanh(slope_s_rad * rate)

    return stribeck


def steepness_Nms_rad(source: LinkSettings | DrivetrainSettings, slope_s_rad: float) -> float:
    """Return a bound on how fast friction rises, or falls, with the rate."""
    viscous, coulomb = source.viscous_Nms_rad, source.coulomb_Nm
    if isinstance(source, DrivetrainSettings) or source.static_Nm is None:
        return viscous + coulomb * slope_s_rad
    fall = _STEEPEST_FALL * (source.static_Nm - coulomb) / source.stribeck_rad_s
    return max(viscous + source.static_Nm * slope_s_rad, fall - viscous)


def check_friction(links: tuple[LinkSettings, ...], slope_s_rad: float, substep_s: float) -> None:
    """Refuse friction so steep that its extrapolation over one substep would oscillate.

    The inertia a joint torque meets is at least that of its two links set free, which makes
    the check sufficient.

    Raises:
        SimError: Naming the joint, the figure and the limit.
    """
    for number, (link, mobility) in enumerate(zip(links, free_mobilities(links), strict=True), 1):
        gain = steepness_Nms_rad(link, slope_s_rad) * mobility * substep_s
        _require_gentle(f"joint {number}", gain, substep_s)
        if link.drivetrain is not None:
            inertia = link.drivetrain.rotor_inertia_kg_m2
            gain = steepness_Nms_rad(link.drivetrain, slope_s_rad) / inertia * substep_s
            _require_gentle(f"the rotor of joint {number}", gain, substep_s)


def free_mobilities(links: tuple[LinkSettings, ...]) -> list[float]:
    """Return per joint 1 / (least inertia its torque can meet), in 1/(kg m^2).

    The least is met if the two links are free, and turn about their centres of mass.
    """
    inverse = [1.0 / link.inertia_kg_m2 for link in links]
    return [own + before for own, before in zip(inverse, [0.0, *inverse], strict=False)]


def _require_gentle(what: str, gain: float, substep_s: float) -> None:
    if gain > 1.0:
        raise SimError(
            f"friction of {what} is too steep for a substep of {substep_s:g} s:"
            f" |d tau_f / d dq| dt / I = {gain:.3g}, limit 1; reduce substep_s,"
            " tanh_slope_s_rad or friction, or raise stribeck_rad_s"
        )
