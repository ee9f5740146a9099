"""Laws that know the arm: passive computed torque and Slotine-Li, with the regressor Y_r of (2).

The arm is a planar chain of n links, q1 from the downward vertical and every other angle relative
to the link before, as in `controller.settings.ModelSettings`. In absolute angles theta and rates
omega (sums of q and dq up to a link) the Lagrange equations of the chain are, for every link i,

    Q_i = sum_k A_ik [cos(theta_i - theta_k) domega_k + sin(theta_i - theta_k) omega_k^2]
          + g b_i sin(theta_i),    A_ii = J_i,    A_ik = l_min(i,k) b_max(i,k),

and the torque of joint j is the sum of Q_i over the links it carries, i >= j, plus its friction.
That is linear in five parameters per joint, which stand in Theta one joint after the other:

| | meaning | unit |
|---|---|---|
| J_i | inertia of link i about its joint, all outer links as a point mass at its end | kg m2 |
| b_i | first moment of link i about its joint, likewise | kg m |
| B_i | viscous friction of joint i | Nms/rad |
| C_i | Coulomb friction of joint i, as C tanh(D dq) | Nm |
| tau_d_i | disturbance torque on joint i; as in (1), positive ones help positive torques | Nm |

The lengths l, gravity g and the slope D are taken as known. C(q, dq) is the matrix of Christoffel
symbols, so that dH/dt - 2 C is skew-symmetric: what the passivity of (9) and (10) rests on.
"""

import math
from abc import abstractmethod
from collections.abc import Sequence
from operator import mul

from controller.gain import ConstantGain
from controller.law import Law, saturation_limits
from controller.player import Setpoint
from controller.settings import PER_JOINT, ControllerSettings, ModelSettings


class PlanarChain:
    """The regressor of a planar chain of n links; see the module.

    Attributes:
        joints: n.
    """

    __slots__ = ("_gravity_m_s2", "_lengths_m", "_slope_s_rad", "joints")

    def __init__(self, model: ModelSettings) -> None:
        self.joints = len(model.links)
        self._lengths_m = [link.length_m for link in model.links]
        self._gravity_m_s2 = model.gravity_m_s2
        self._slope_s_rad = model.tanh_slope_s_rad

    def regressor(
        self,
        q_rad: Sequence[float],
        dq_rad_s: Sequence[float],
        dq_r_rad_s: Sequence[float],
        ddq_r_rad_s2: Sequence[float],
    ) -> list[list[float]]:
        """Return Y_r of (2): H ddq_r + C dq_r + g + B dq_r + C tanh(D dq_r) - tau_d = Y_r Theta.

        With dq_r = dq and ddq_r = ddq it is the inverse dynamics of (1).

        Args:
            q_rad: Joint angles.
            dq_rad_s: Joint rates, in C(q, dq) alone.
            dq_r_rad_s: Nominal reference (5).
            ddq_r_rad_s2: Its derivative.

        Returns:
            n rows of 5 n entries; row j is the torque of joint j per unit of every parameter.
        """
        n = self.joints
        rows = [[0.0] * (PER_JOINT * n) for _ in range(n)]
        inner: list[tuple[float, float, float, float]] = []
        angle = rate = rate_r = rate_change_r = 0.0
        for i, length_m in enumerate(self._lengths_m):
            angle += q_rad[i]
            rate += dq_rad_s[i]
            rate_r += dq_r_rad_s[i]
            rate_change_r += ddq_r_rad_s2[i]
            at = PER_JOINT * i
            moment = self._gravity_m_s2 * math.sin(angle)
            for k, (angle_k, length_k_m, gyration_k, change_k) in enumerate(inner):
                c, s = math.cos(angle - angle_k), math.sin(angle - angle_k)
                moment += length_k_m * (c * change_k + s * gyration_k)
                rows[k][at + 1] = length_k_m * (c * rate_change_r - s * rate * rate_r)
            inner.append((angle, length_m, rate * rate_r, rate_change_r))
            for k in range(i, -1, -1):  # a joint carries what all links beyond it need
                rows[k][at] = rate_change_r
                moment += rows[k][at + 1]
                rows[k][at + 1] = moment
            rows[i][at + 2] = dq_r_rad_s[i]
            rows[i][at + 3] = math.tanh(self._slope_s_rad * dq_r_rad_s[i])
            rows[i][at + 4] = -1.0
        return rows


def parameters(model: ModelSettings) -> list[float]:
    """Return Theta of a model, tau_d being zero."""
    Theta: list[float] = []
    mass_beyond_kg = 0.0
    for link in reversed(model.links):
        first_moment = link.mass_kg * link.com_m + mass_beyond_kg * link.length_m
        inertia = (
            link.inertia_kg_m2 + link.mass_kg * link.com_m**2 + mass_beyond_kg * link.length_m**2
        )
        Theta[:0] = [inertia, first_moment, link.viscous_Nms_rad, link.coulomb_Nm, 0.0]
        mass_beyond_kg += link.mass_kg
    return Theta


class ModelBasedLaw(Law):
    """tau = -Kd S_q + Y_r Theta with dq_r = dq_d - alpha q_err, so that S_q = dq - dq_r.

    There is no integral term, and Kd is constant within its bounds.

    Attributes:
        Theta: Parameters that act in the next step; see the module.

    Raises:
        ValueError: If the settings have no model of the arm.
    """

    def __init__(self, settings: ControllerSettings) -> None:
        law, tau_max_Nm = settings.law, settings.limits.tau_max_Nm
        if settings.model is None:
            raise ValueError(f"law {law.name} needs a model of the arm: controller.model")
        joints = range(len(tau_max_Nm))
        self.Theta = parameters(settings.model)
        self.gains = [
            ConstantGain(law.Kd[j], (law.Kd_min[j], law.Kd_max[j]), law.Kd_ramp_per_s)
            for j in joints
        ]
        self.S = [0.0 for _ in joints]
        self.sigma = [0.0 for _ in joints]
        self.Kd = list(law.Kd)
        self._chain = PlanarChain(settings.model)
        self._alpha = list(law.alpha)
        self._limits_Nm = saturation_limits(law, tau_max_Nm)
        self._is_clipped = law.tau_clip_Nm is not None

    def reset(self) -> None:
        """Nothing is integrated."""

    def step(
        self,
        q_rad: Sequence[float],
        dq_rad_s: Sequence[float],
        setpoint: Setpoint,
        dt_s: float,
    ) -> list[float]:
        """See `Law.step`."""
        S, dq_r, ddq_r = [], [], []
        for alpha, q, dq, q_d, dq_d, ddq_d in zip(
            self._alpha, q_rad, dq_rad_s, *setpoint, strict=True
        ):
            rate_r = dq_d - alpha * (q - q_d)
            S.append(dq - rate_r)
            dq_r.append(rate_r)
            ddq_r.append(ddq_d - alpha * (dq - dq_d))
        Y = self._chain.regressor(q_rad, dq_rad_s, dq_r, ddq_r)
        Kd = [gain.step(s, dt_s) for gain, s in zip(self.gains, S, strict=True)]
        tau = [sum(map(mul, y, self.Theta)) - k * s for y, k, s in zip(Y, Kd, S, strict=True)]
        limits = self._limits_Nm
        is_saturated = any(abs(t) > limit for t, limit in zip(tau, limits, strict=True))
        if not is_saturated:
            self._adapt(Y, S, dt_s)
        elif self._is_clipped:
            tau = [max(-limit, min(limit, t)) for t, limit in zip(tau, limits, strict=True)]
        self.S, self.Kd = S, Kd
        return tau

    @abstractmethod
    def _adapt(self, Y: list[list[float]], S_q: list[float], dt_s: float) -> None:
        """Change Theta after use; called in cycles in which no joint's torque is saturated."""


class ComputedTorqueLaw(ModelBasedLaw):
    """Passive computed torque, paper 3.2.1: Theta is the model's and stays."""

    def _adapt(self, Y: list[list[float]], S_q: list[float], dt_s: float) -> None:
        pass


class SlotineLiLaw(ModelBasedLaw):
    """Adaptive passive computed torque, paper 3.2.2: Theta' = -Gamma Y_r' S_q.

    Forward Euler after use. Theta waits in cycles in which a torque is saturated, and starts anew
    when power comes on. The box, where one is set, keeps every entry within it.

    Y_r and S_q share the noise of the measured rate, and their product has a mean: J drifts
    upwards (on scenario A with default gains to 0.09 kg m2 at joint 2 within 20 s, the arm's own
    being 0.04). Larger gains make tracking worse; a small Gamma for J, or the box, contains it.
    """

    def __init__(self, settings: ControllerSettings) -> None:
        super().__init__(settings)
        adaptation, joints = settings.slotine_li, len(self.S)
        if adaptation.start == "zero":
            self.Theta = [0.0] * len(self.Theta)
        self._Theta_0 = list(self.Theta)
        self._Gamma = list(adaptation.Gamma) * (len(self.Theta) // len(adaptation.Gamma))
        self._box = None
        if adaptation.Theta_max is not None:
            *positive, disturbance = adaptation.Theta_max
            box = [*((0.0, most) for most in positive), (-disturbance, disturbance)]
            self._box = box * joints

    def reset(self) -> None:
        """Set Theta to where it starts."""
        self.Theta = list(self._Theta_0)

    def _adapt(self, Y: list[list[float]], S_q: list[float], dt_s: float) -> None:
        self.Theta = [
            theta - dt_s * gamma * sum(map(mul, column, S_q))
            for theta, gamma, column in zip(
                self.Theta, self._Gamma, zip(*Y, strict=True), strict=True
            )
        ]
        if self._box is not None:
            self.Theta = [
                max(low, min(high, theta))
                for theta, (low, high) in zip(self.Theta, self._box, strict=True)
            ]
