"""Gravity torques of a planar chain, and the rate at which a stop lets the arm down."""

import math
from collections.abc import Sequence

from controller.settings import LimitSettings, ModelSettings

_FULL_SHARE = 0.04
"""Of the torque limit: with a gravity torque above this share, a joint is let down at full rate."""


class GravityLoad:
    """What gravity asks of each joint, by the model of the arm.

    Angles are q1 from the downward vertical, the others relative to the previous link.
    """

    __slots__ = ("_lengths_m", "_links", "_lowering_rad_s", "_small_Nm")

    def __init__(self, model: ModelSettings, limits: LimitSettings) -> None:
        g = model.gravity_m_s2
        self._links = [(link.mass_kg * g, link.com_m) for link in model.links]
        self._lengths_m = [link.length_m for link in model.links]
        self._lowering_rad_s = limits.lowering_rad_s
        self._small_Nm = [_FULL_SHARE * tau for tau in limits.tau_max_Nm]

    def torques_Nm(self, q_rad: Sequence[float]) -> list[float]:
        """Return dU/dq_j of the potential energy U, the torque that holds the arm up.

        With phi_k = q_1 + ... + q_k and links k of weight w_k:
        dU/dq_j = sum over i >= j of w_i (sum over j <= k < i of l_k sin phi_k + c_i sin phi_i).
        """
        torques, angle = [0.0] * len(self._links), 0.0
        outer_N = sum(weight for weight, _ in self._links)
        for k, (weight_N, com_m) in enumerate(self._links):
            angle += q_rad[k]
            outer_N -= weight_N
            lever_Nm = (weight_N * com_m + outer_N * self._lengths_m[k]) * math.sin(angle)
            for j in range(k + 1):
                torques[j] += lever_Nm
        return torques

    def lowering_rad_s(self, torques_Nm: Sequence[float]) -> list[float]:
        """Return the rates at which a stop lets the joints down: the way gravity pulls them."""
        rates = []
        for torque, small in zip(torques_Nm, self._small_Nm, strict=True):
            share = max(-1.0, min(1.0, torque / small))
            rates.append(-share * self._lowering_rad_s)
        return rates

    def is_down(self, torques_Nm: Sequence[float]) -> bool:
        """Tell whether the arm hangs so low that it stays there without torque, or nearly."""
        return all(abs(tau) < small for tau, small in zip(torques_Nm, self._small_Nm, strict=True))
