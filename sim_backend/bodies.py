"""What a link is to pymunk: a body where the joints put it, and stops between two bodies."""

from math import inf

import pymunk

from sim_backend.linkage import LinkMotion
from sim_backend.settings import LinkSettings


def place_body(motion: LinkMotion) -> pymunk.Body:
    """Return a link's body, its position being that of the centre of mass."""
    body = pymunk.Body(motion.link.mass_kg, motion.link.inertia_kg_m2)
    body.angle, body.angular_velocity = motion.angle_rad, motion.rate_rad_s
    body.position = (motion.x_m, motion.y_m)
    body.velocity = (motion.vx_m_s, motion.vy_m_s)
    return body


def make_stops(
    link: LinkSettings, before: pymunk.Body, body: pymunk.Body
) -> list[pymunk.RotaryLimitJoint]:
    """Return the joint's stops, if any.

    They keep their default bias; with none, as the pivots have it, they rebound and chatter.
    """
    low, high = link.q_min_rad, link.q_max_rad
    if low is None and high is None:
        return []
    stop = pymunk.RotaryLimitJoint(
        before, body, -inf if low is None else low, inf if high is None else high
    )
    stop.collide_bodies = False
    return [stop]
