"""Where the links of a planar chain are, and how they move, from its joint angles and rates."""

from collections.abc import Iterator, Sequence
from math import cos, sin
from typing import NamedTuple

from sim_backend.settings import LinkSettings, PlantSettings


class LinkMotion(NamedTuple):
    """Motion of one link's centre of mass in the base frame: x downwards, y to the right."""

    link: LinkSettings
    angle_rad: float
    rate_rad_s: float
    x_m: float
    y_m: float
    vx_m_s: float
    vy_m_s: float


def link_motions(
    links: Sequence[LinkSettings], q_rad: Sequence[float], dq_rad_s: Sequence[float]
) -> Iterator[LinkMotion]:
    """Yield the motion of each link, from the shoulder outwards.

    Args:
        links: The chain.
        q_rad: Joint angles, each relative to the link before; the first from the downward
            vertical.
        dq_rad_s: Joint rates.
    """
    angle = rate = x = y = vx = vy = 0.0
    for link, q, dq in zip(links, q_rad, dq_rad_s, strict=True):
        angle += q
        rate += dq
        c, s = cos(angle), sin(angle)
        com, length = link.com_m, link.length_m
        velocity = (vx - com * s * rate, vy + com * c * rate)
        yield LinkMotion(link, angle, rate, x + com * c, y + com * s, *velocity)
        x, y = x + length * c, y + length * s
        vx, vy = vx - length * s * rate, vy + length * c * rate


def chain_energy_J(
    settings: PlantSettings, q_rad: Sequence[float], dq_rad_s: Sequence[float]
) -> float:
    """Kinetic plus potential energy; the potential is zero at the height of the shoulder."""
    energy_J = 0.0
    for motion in link_motions(settings.links, q_rad, dq_rad_s):
        link = motion.link
        speed_squared = motion.vx_m_s * motion.vx_m_s + motion.vy_m_s * motion.vy_m_s
        energy_J += 0.5 * link.mass_kg * speed_squared
        energy_J += 0.5 * link.inertia_kg_m2 * motion.rate_rad_s * motion.rate_rad_s
        energy_J -= link.mass_kg * settings.gravity_m_s2 * motion.x_m
    return energy_J
