"""Objects at the tip: the laden link, when it is laden, and the jolt of a resting object."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from sim_backend.linkage import mass_matrix
from sim_backend.settings import LinkSettings, PayloadSettings


class PayloadEvent(NamedTuple):
    """A change of what the arm carries. Of two at one instant, the drop comes first."""

    at_ns: int
    is_pick_up: bool
    payload: PayloadSettings


def payload_events(payloads: Iterable[PayloadSettings]) -> list[PayloadEvent]:
    """Return pick-ups and drops in order, without the payloads carried from the start."""
    events = []
    for payload in payloads:
        if payload.pick_s > 0.0:
            events.append(PayloadEvent(round(payload.pick_s * 1e9), True, payload))
        if payload.drop_s is not None:
            events.append(PayloadEvent(round(payload.drop_s * 1e9), False, payload))
    return sorted(events, key=lambda event: event[:2])


def laden(link: LinkSettings, payloads: Sequence[PayloadSettings]) -> LinkSettings:
    """Return the link with payloads fixed to its tip, as one body (parallel-axis theorem)."""
    if not payloads:
        return link
    carried_kg = sum(payload.mass_kg for payload in payloads)
    mass_kg = link.mass_kg + carried_kg
    com_m = (link.mass_kg * link.com_m + carried_kg * link.length_m) / mass_kg
    inertia = link.inertia_kg_m2 + link.mass_kg * (com_m - link.com_m) ** 2
    inertia += carried_kg * (link.length_m - com_m) ** 2
    inertia += sum(payload.inertia_kg_m2 for payload in payloads)
    return link.model_copy(update={"mass_kg": mass_kg, "com_m": com_m, "inertia_kg_m2": inertia})


def rates_after_catch(
    before: Sequence[LinkSettings],
    after: Sequence[LinkSettings],
    q_rad: Sequence[float],
    dq_rad_s: Sequence[float],
) -> list[float]:
    """Return the joint rates after the arm has caught a resting object.

    The impulse passes through the hand alone: M' v+ = M v-, with M' the mass matrix of the laden
    arm and M that of the arm before.

    Args:
        before: The links as they were.
        after: The links with the object.
        q_rad: Joint angles.
        dq_rad_s: Joint rates before.
    """
    momentum = mass_matrix(before, q_rad) @ np.asarray(dq_rad_s)
    rates: list[float] = np.linalg.solve(mass_matrix(after, q_rad), momentum).tolist()
    return rates
