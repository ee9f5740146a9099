"""Where the links of a planar chain are, and how they move, from its joint angles and rates."""

from collections.abc import Iterator, Sequence
from itertools import accumulate
from math import cos, sin
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from sim_backend.settings import LinkSettings


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
    links: Sequence[LinkSettings],
    gravity_m_s2: float,
    q_rad: Sequence[float],
    dq_rad_s: Sequence[float],
) -> float:
    """Kinetic plus potential energy; the potential is zero at the height of the shoulder."""
    energy_J = 0.0
    for motion in link_motions(links, q_rad, dq_rad_s):
        link = motion.link
        speed_squared = motion.vx_m_s * motion.vx_m_s + motion.vy_m_s * motion.vy_m_s
        energy_J += 0.5 * link.mass_kg * speed_squared
        energy_J += 0.5 * link.inertia_kg_m2 * motion.rate_rad_s * motion.rate_rad_s
        energy_J -= link.mass_kg * gravity_m_s2 * motion.x_m
    return energy_J


def mass_matrix(links: Sequence[LinkSettings], q_rad: Sequence[float]) -> npt.NDArray[np.float64]:
    """Return M(q) of `M(q) ddq + ... = tau`, shape (n, n), for joint rates dq.

    Built from the Jacobians J_k of the links' centres of mass:
    `M = sum_k m_k J_k' J_k + I_k 1_k 1_k'`, where 1_k has ones for the joints up to k.
    """
    count = len(links)
    angles = list(accumulate(q_rad))
    along = np.array([(cos(angle), sin(angle)) for angle in angles])
    matrix = np.zeros((count, count))
    joint_m = np.zeros((count, 2))  # of each joint so far
    tip_m = np.zeros(2)
    for k, link in enumerate(links):
        joint_m[k] = tip_m
        levers_m = tip_m + link.com_m * along[k] - joint_m[: k + 1]  # turned by 90 deg: J_k
        matrix[: k + 1, : k + 1] += link.mass_kg * levers_m @ levers_m.T + link.inertia_kg_m2
        tip_m = tip_m + link.length_m * along[k]
    return matrix


def outstretched_inertias_kg_m2(links: Sequence[LinkSettings]) -> list[float]:
    """Return about each joint the inertia of all that it carries, stretched out: its largest."""
    inertias = []
    for first in range(len(links)):
        reach_m = inertia = 0.0
        for link in links[first:]:
            inertia += link.inertia_kg_m2 + link.mass_kg * (reach_m + link.com_m) ** 2
            reach_m += link.length_m
        inertias.append(inertia)
    return inertias
