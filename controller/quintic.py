"""Piecewise quintics: the C2 (and smoother) curves that references are made of. numpy only."""

from typing import TypeAlias

import numpy as np

from controller.reference import FloatArray

Motion: TypeAlias = tuple[FloatArray, FloatArray, FloatArray]
"""Positions, velocities and accelerations; arrays of one shape, joints last."""

_NODES = np.arange(-2.0, 3.0)
_POWERS = np.arange(5)
_TO_QUARTIC = np.linalg.inv(np.vander(_NODES, increasing=True))
# Row i: weights of the derivative, at node i, of the quartic through five equidistant points.
_FIRST = (_POWERS * _NODES[:, None] ** np.maximum(_POWERS - 1, 0)) @ _TO_QUARTIC
_SECOND = (_POWERS * (_POWERS - 1) * _NODES[:, None] ** np.maximum(_POWERS - 2, 0)) @ _TO_QUARTIC
STENCIL_POINTS = 5


def coefficients(span_s: FloatArray | float, start: Motion, end: Motion) -> FloatArray:
    """Coefficients of the quintics that join given motions (Hermite interpolation).

    Args:
        span_s: Duration of each piece, > 0, broadcast against the motions.
        start: Motion at the start of each piece.
        end: Motion at its end.

    Returns:
        Coefficients c[k] of u**k, u = 0 .. 1 along the piece; shape (6, *motion shape).
    """
    q0, v0, a0 = start[0], start[1] * span_s, start[2] * span_s**2
    q1, v1, a1 = end[0], end[1] * span_s, end[2] * span_s**2
    d = q1 - q0
    return np.stack(
        (
            q0,
            v0,
            0.5 * a0,
            10.0 * d - 6.0 * v0 - 4.0 * v1 - 1.5 * a0 + 0.5 * a1,
            -15.0 * d + 8.0 * v0 + 7.0 * v1 + 1.5 * a0 - a1,
            6.0 * d - 3.0 * v0 - 3.0 * v1 - 0.5 * a0 + 0.5 * a1,
        )
    )


def evaluate(c: FloatArray, u: FloatArray, span_s: FloatArray | float) -> Motion:
    """Position, velocity and acceleration at u = 0 .. 1 along pieces of duration `span_s`."""
    q = c[0] + u * (c[1] + u * (c[2] + u * (c[3] + u * (c[4] + u * c[5]))))
    dq = c[1] + u * (2.0 * c[2] + u * (3.0 * c[3] + u * (4.0 * c[4] + u * 5.0 * c[5])))
    ddq = 2.0 * c[2] + u * (6.0 * c[3] + u * (12.0 * c[4] + u * 20.0 * c[5]))
    return q, dq / span_s, ddq / span_s**2


def interpolate(times_s: FloatArray, knots: Motion, at_s: FloatArray) -> Motion:
    """Evaluate the C2 piecewise quintic through `knots` at the instants `at_s`.

    Args:
        times_s: Strictly increasing, shape (m,), m >= 2.
        knots: Motion at those times, arrays of shape (m, joints).
        at_s: Instants within the times, shape (n,).

    Returns:
        Motion at those instants, arrays of shape (n, joints).
    """
    span_s = np.diff(times_s)[:, None]
    q, dq, ddq = knots
    pieces = coefficients(span_s, (q[:-1], dq[:-1], ddq[:-1]), (q[1:], dq[1:], ddq[1:]))
    piece = np.clip(np.searchsorted(times_s, at_s, side="right") - 1, 0, len(span_s) - 1)
    u = (at_s - times_s[piece])[:, None] / span_s[piece]
    return evaluate(pieces[:, piece], u, span_s[piece])


def stencil_knots(period_s: float, q_rad: FloatArray) -> Motion:
    """Give equidistant samples velocities and accelerations from five-point differences.

    Exact for quartics; at the two samples next to either end the stencil is one-sided.

    Args:
        period_s: Time between samples, > 0.
        q_rad: Samples, shape (m, joints), m >= STENCIL_POINTS.
    """
    derivatives = []
    for weights, scale in ((_FIRST, 1.0 / period_s), (_SECOND, 1.0 / period_s**2)):
        inner = sum(w * q_rad[i : len(q_rad) - 4 + i] for i, w in enumerate(weights[2]))
        ends = weights[:2] @ q_rad[:5], inner, weights[3:] @ q_rad[-5:]
        derivatives.append(np.concatenate(ends) * scale)
    return q_rad, derivatives[0], derivatives[1]


def minimum_jerk_knots(times_s: FloatArray, q_rad: FloatArray) -> Motion:
    """Give timed points velocities and accelerations of least squared jerk, at rest at both ends.

    The curve through them is the quintic spline: jerk and snap are continuous as well. They
    follow from a symmetric positive definite block-tridiagonal system with one 2 x 2 block
    (velocity, acceleration) per inner point, solved by block elimination.

    Args:
        times_s: Strictly increasing, shape (m,), m >= 2.
        q_rad: Points, shape (m, joints).
    """
    inner = np.zeros((len(times_s) - 2, 2, q_rad.shape[1]))
    if len(inner):
        inner = _solve_blocks(*_jerk_equations(np.diff(times_s), np.diff(q_rad, axis=0)))
    rest = np.zeros((1, q_rad.shape[1]))
    dq = np.concatenate((rest, inner[:, 0], rest))
    ddq = np.concatenate((rest, inner[:, 1], rest))
    return q_rad, dq, ddq


def _jerk_equations(
    span_s: FloatArray, step_rad: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Continuity of snap and jerk at each inner point: diagonal, upper blocks, right side."""
    h, k = span_s[:-1], span_s[1:]
    mixed = 36.0 / k**2 - 36.0 / h**2
    diagonal = _blocks(192.0 / h**3 + 192.0 / k**3, mixed, mixed, 9.0 / h + 9.0 / k)
    g = k[:-1]
    upper = _blocks(168.0 / g**3, -24.0 / g**2, 24.0 / g**2, -3.0 / g)
    left, right = step_rad[:-1], step_rad[1:]
    h, k = h[:, None], k[:, None]
    snap = 360.0 * (left / h**4 + right / k**4)
    jerk = 60.0 * (right / k**3 - left / h**3)
    return diagonal, upper, np.stack((snap, jerk), axis=1)


def _blocks(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
    return np.stack((a, b, c, d), axis=-1).reshape(-1, 2, 2)


def _solve_blocks(diagonal: FloatArray, upper: FloatArray, rhs: FloatArray) -> FloatArray:
    """Solve the symmetric block-tridiagonal system; overwrites its arguments."""
    inverse = np.empty_like(diagonal)
    for i in range(len(diagonal)):
        if i:
            factor = upper[i - 1].T @ inverse[i - 1]
            diagonal[i] -= factor @ upper[i - 1]
            rhs[i] -= factor @ rhs[i - 1]
        (a, b), (c, d) = diagonal[i]
        inverse[i] = np.array(((d, -b), (-c, a))) / (a * d - b * c)
    solution = np.empty_like(rhs)
    solution[-1] = inverse[-1] @ rhs[-1]
    for i in range(len(rhs) - 2, -1, -1):
        solution[i] = inverse[i] @ (rhs[i] - upper[i] @ solution[i + 1])
    return solution
