"""What the paper says of S, watched every cycle: storage, dissipation, regions, ultimate bound.

Nothing here acts on the arm. S is the law's own, with the noise of the velocity estimate in it.

**Demand.** In (36), S'Kd S > |S' Y_r Theta|, the right side is not measurable without a model. By
(3), Y_r Theta = tau - (H dS + C S): once the transient is over, the bracket has no mean, and
Y_r Theta is the slow part of the torque. The estimate is therefore the sent torque behind a
first-order low-pass, and the demand |S' tau_need|. It needs no model, and it means little during
the first tenths of a second, when most of the torque accelerates S. Since tau = -Kd S, a steady
state has S'Kd S = |S' Y_r Theta| by construction: (36) holds while S decays, and it cannot hold
throughout at the ultimate bound. There the noise of S is counted as dissipation alone, which
tilts the comparison in favour of (36).
"""

import math
from collections.abc import Sequence

from controller.settings import MonitorSettings

OMEGA_KD_RAD_S = 1.0
"""A joint is in region Omega_Kd while |S_j| is below this, else in Omega_alpha (6.1)."""
_BUCKETS = 10


class Monitor:
    """Figures of one arm, brought up to date once per step of the law.

    Attributes:
        V_rad2_s2: Storage S'S / 2 (29).
        dissipation_W: Dissipation rate S'Kd S (10), (36).
        demand_W: Estimate of |S' Y_r Theta|; see the module.
        tau_need_Nm: Estimate of Y_r Theta, per joint.
        in_Omega_Kd: 1.0 where |S_j| < 1, else 0.0.
        entries: How often each joint has come into Omega_Kd since power came on.
        exits: How often it has left it.
        S_bound_rad_s: Largest |S_j| of the trailing window, which is 0.9 to 1 times as long as set.
    """

    __slots__ = (
        "S_bound_rad_s",
        "V_rad2_s2",
        "_age_s",
        "_bucket_s",
        "_buckets",
        "_dt_s",
        "_has_started",
        "_rate_per_s",
        "_share",
        "demand_W",
        "dissipation_W",
        "entries",
        "exits",
        "in_Omega_Kd",
        "tau_need_Nm",
    )

    def __init__(self, settings: MonitorSettings, joints: int) -> None:
        self._rate_per_s = 2.0 * math.pi * settings.demand_cutoff_Hz
        self._bucket_s = settings.window_s / _BUCKETS
        self._dt_s = self._share = 0.0
        self.S_bound_rad_s = [0.0] * joints
        self.reset()

    def reset(self) -> None:
        """Begin anew: power comes on, the next step is the first."""
        zeros = [0.0] * len(self.S_bound_rad_s)
        self.V_rad2_s2 = self.dissipation_W = self.demand_W = 0.0
        self.tau_need_Nm = list(zeros)
        self.in_Omega_Kd = list(zeros)
        self.entries = list(zeros)
        self.exits = list(zeros)
        self.S_bound_rad_s = list(zeros)
        self._buckets = [list(zeros) for _ in range(_BUCKETS)]
        self._age_s = 0.0
        self._has_started = False

    def step(
        self, S: Sequence[float], Kd: Sequence[float], tau_sent_Nm: Sequence[float], dt_s: float
    ) -> None:
        """Take one cycle.

        Args:
            S: Error manifold, rad/s, finite.
            Kd: Gains in use, Nms/rad.
            tau_sent_Nm: Torques after limits.
            dt_s: Time since the last step.
        """
        if dt_s != self._dt_s:
            self._dt_s, self._share = dt_s, 1.0 - math.exp(-self._rate_per_s * dt_s)
        self._age_s += dt_s
        if self._age_s >= self._bucket_s or not self._has_started:
            self._begin_bucket(S)
        share, need, inside = self._share, self.tau_need_Nm, self.in_Omega_Kd
        bound, newest = self.S_bound_rad_s, self._buckets[-1]
        V = dissipation = demand = 0.0
        for j, s in enumerate(S):
            square = s * s
            V += square
            dissipation += Kd[j] * square
            need_j = need[j]
            need_j += share * (tau_sent_Nm[j] - need_j)
            need[j] = need_j
            demand += s * need_j
            size = s if s >= 0.0 else -s
            if size > newest[j]:
                newest[j] = size
                bound[j] = max(bound[j], size)
            if (size < OMEGA_KD_RAD_S) != inside[j]:
                self._cross(j)
        self.V_rad2_s2 = 0.5 * V
        self.dissipation_W = dissipation
        self.demand_W = demand if demand >= 0.0 else -demand

    def _cross(self, joint: int) -> None:
        """Note that a joint has changed its region."""
        if self.in_Omega_Kd[joint]:
            self.in_Omega_Kd[joint] = 0.0
            self.exits[joint] += 1.0
        else:
            self.in_Omega_Kd[joint] = 1.0
            self.entries[joint] += 1.0

    def _begin_bucket(self, S: Sequence[float]) -> None:
        """Forget the oldest tenth of the window; in the first step, note where S starts."""
        if not self._has_started:
            self._has_started = True
            self.in_Omega_Kd = [1.0 if abs(s) < OMEGA_KD_RAD_S else 0.0 for s in S]
        self._age_s = 0.0
        self._buckets.append(self._buckets.pop(0))
        self._buckets[-1] = [0.0] * len(S)
        self.S_bound_rad_s = [max(column) for column in zip(*self._buckets, strict=True)]
