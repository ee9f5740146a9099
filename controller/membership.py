"""To what degree |S| is big, medium or small: the membership functions of figs 2 and 6.

The gain is the plain sum (17) of consequences, Kd_hat = sum_i beta_i mu_i(|S|), whose place
between the smallest and the largest beta depends on the memberships alone. With the paper's
beta = (1, 2, 4) for (big, medium, small), and |S| in rad/s:

| name | sum of degrees | Kd(0), Kd(1) | Kd never rises | torque Kd(S) S never falls |
|---|---|---|---|---|
| `sigmoid` | 1 | 3.980, 1.034 | for every falling beta | yes (least slope 0.011) |
| `gaussian_normalised` | 1 | 3.943, 1.012 | for every falling beta | yes (least slope 0.177) |
| `triangular` | 1 | 4, 1 | for every falling beta | no: falls by 1/16 in 0.8 .. 1 |
| `gaussian_clipped` | 1.13 .. 0 | 4, 1 | not for every beta | no: falls by 1/8 in 0.48 .. 0.86 |

A falling beta is one with beta_small >= beta_medium >= beta_big. "Torque never falls" depends on
beta: consequences further apart lose it (beyond beta_small / beta_big = 4.03 with `sigmoid`, 4.65
with `gaussian_normalised`, the medium one at a third of the way). Where torque falls as the error
grows, the incremental gain of the joint is negative.
"""

import math
from collections.abc import Callable
from types import MappingProxyType
from typing import Final

Degrees = tuple[float, float, float]
"""Degrees of (big, medium, small), each in [0, 1]."""
Membership = Callable[[float], Degrees]
"""Takes |S| >= 0 in rad/s."""

BIG, MEDIUM, SMALL = 0, 1, 2

_FAR_RAD_S: Final = 20.0  # beyond: the value in the limit, without overflow
_FAR_GAUSSIAN_RAD_S: Final = 5.0
_NORMALISED: Final = (0.0, 0.4, 0.6, 0.15)  # centres of small, medium, big; their common width
_CLIPPED: Final = (0.0, 0.4, 0.8, 0.17)
_TRIANGLES: Final = (0.4, 1.0)  # centres of medium and big; small's is zero


def sigmoid(S_abs: float) -> Degrees:
    """Two sigmoids: a = sigm((s - 0.20) / 0.04), b = sigm((s - 0.60) / 0.12); the default.

    small = 1 - a, medium = a - b, big = b. A partition of unity: a >= b for every s >= 0, since
    3 (s - 0.20) >= s - 0.60 there. Kd = beta_s - (beta_s - beta_m) a - (beta_m - beta_b) b falls
    with s for every falling beta, because a and b rise.
    """
    a = 1.0 / (1.0 + math.exp((0.20 - S_abs) / 0.04)) if S_abs < _FAR_RAD_S else 1.0
    b = 1.0 / (1.0 + math.exp((0.60 - S_abs) / 0.12)) if S_abs < _FAR_RAD_S else 1.0
    medium = a - b
    return b, medium if medium > 0.0 else 0.0, 1.0 - a


def gaussian_normalised(S_abs: float) -> Degrees:
    """Gaussians around 0, 0.4 and 0.6 rad/s of one width, 0.15, divided by their sum.

    A partition of unity by construction. One width makes the exponents' differences linear in s,
    so that dKd/ds is the covariance of beta with the centres over width^2: not positive for every
    falling beta. With different widths the widest would win far away.
    """
    if S_abs >= _FAR_GAUSSIAN_RAD_S:
        return 1.0, 0.0, 0.0
    small, medium, big = _gaussians(S_abs, *_NORMALISED)
    total = small + medium + big
    return big / total, medium / total, small / total


def gaussian_clipped(S_abs: float) -> Degrees:
    """Gaussians around 0, 0.4 and 0.8 rad/s of width 0.17, as they are: to be used with care.

    Neighbours cross at one half. Not a partition of unity: their sum is 1.13 near 0.4 rad/s and
    goes to zero beyond 1 rad/s, so that the plain sum (17) of (1, 2, 4) reaches 4.14 and 0. Only
    the box [Kd_min, Kd_max] to which the gain is clipped keeps it in bounds; far away Kd is Kd_min
    whatever beta_big says, and three equal consequences do not give a constant gain.
    """
    if S_abs >= _FAR_GAUSSIAN_RAD_S:
        return 0.0, 0.0, 0.0
    small, medium, big = _gaussians(S_abs, *_CLIPPED)
    return big, medium, small


def triangular(S_abs: float) -> Degrees:
    """Triangles with corners at 0, 0.4 and 1 rad/s; big stays at one beyond.

    A partition of unity, piecewise linear; Kd is the broken line through the consequences.
    """
    middle, far = _TRIANGLES
    if S_abs >= far:
        return 1.0, 0.0, 0.0
    if S_abs <= middle:
        medium = S_abs / middle
        return 0.0, medium, 1.0 - medium
    big = (S_abs - middle) / (far - middle)
    return big, 1.0 - big, 0.0


def _gaussians(
    S_abs: float, small: float, medium: float, big: float, width: float
) -> tuple[float, float, float]:
    scale = -0.5 / (width * width)
    return (
        math.exp(scale * (S_abs - small) ** 2),
        math.exp(scale * (S_abs - medium) ** 2),
        math.exp(scale * (S_abs - big) ** 2),
    )


MEMBERSHIPS: Final = MappingProxyType(
    {
        "sigmoid": sigmoid,
        "gaussian_normalised": gaussian_normalised,
        "gaussian_clipped": gaussian_clipped,
        "triangular": triangular,
    }
)
"""Every membership by its name in the configuration (`controller.law.membership`)."""
