"""How fast the error manifold decays, free of encoder noise."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.fixed_protobuf import Records

Array = NDArray[np.float64]

_SETTLED_SHARE: Final = 0.1  # of |S(0)|
_SMALLEST_S0_rad_s: Final = 0.1  # below this there is no initial error whose decay means anything
_SMOOTHING_HALF_WIDTH_S: Final = 12e-3


def has_truth(rows: Records) -> bool:
    """Tell whether every row carries the plant's own motion (simulation)."""
    return "q_true_rad" in (rows.dtype.names or ()) and bool(np.isfinite(rows["q_true_rad"]).all())


def decay_rates(rows: Records) -> Array:
    """Return ln 10 / (first time |S| < 10 % of |S(0)|) per joint, with S free of encoder noise.

    NaN if S starts at zero (no initial error) or never decays.
    """
    S = np.abs(noise_free_manifold(rows))
    t_s = rows["t_ref_s"]
    rates = np.full(S.shape[1], np.nan)
    for joint, column in enumerate(S.T):
        settled = np.flatnonzero(column < _SETTLED_SHARE * column[0])
        if len(settled) and column[0] > _SMALLEST_S0_rad_s and t_s[settled[0]] > 0.0:
            rates[joint] = math.log(10.0) / t_s[settled[0]]
    return rates


def noise_free_manifold(rows: Records) -> Array:
    """Return S without encoder noise: from the plant's own motion, else from the encoder smoothed.

    alpha and Ki are those with which the recorded S was made.
    """
    if has_truth(rows):
        q, dq = rows["q_true_rad"], rows["dq_true_rad_s"]
    else:
        q, dq = smoothed_motion(rows["t_ref_s"], rows["q_meas_rad"])
    measured_q, measured_dq = rows["q_meas_rad"], rows["dq_meas_rad_s"]
    alpha = _position_gains(rows)
    return np.asarray(rows["S_rad_s"] + (dq - measured_dq) + alpha * (q - measured_q))


def _position_gains(rows: Records) -> Array:
    """Return alpha per joint: S = dq_err + alpha q_err + Ki sigma, paper (6), (7), is exact."""
    error = rows["q_meas_rad"] - rows["q_des_rad"]
    rest = rows["S_rad_s"] - (rows["dq_meas_rad_s"] - rows["dq_des_rad_s"])
    alpha = np.full(error.shape[1], np.nan)
    for joint in range(error.shape[1]):
        terms = np.column_stack((error[:, joint], rows["sigma"][:, joint], rest[:, joint]))
        terms = terms[np.isfinite(terms).all(axis=1)]
        if len(terms):
            alpha[joint] = np.linalg.lstsq(terms[:, :2], terms[:, 2])[0][0]
    return alpha


def smoothed_motion(t_s: Array, q_rad: Array) -> tuple[Array, Array]:
    """Return position and rate from sampled positions, without lag.

    A quadratic is fitted around every sample (over 12 ms to each side; at the ends over the first
    and last 24 ms), after the samples have been brought to an even grid.

    Args:
        t_s: Rising instants; skipped cycles leave gaps.
        q_rad: One column per joint.
    """
    dt_s = float(np.median(np.diff(t_s)))
    grid_s = np.arange(t_s[0], t_s[-1] + dt_s / 2, dt_s)
    half = min(round(_SMOOTHING_HALF_WIDTH_S / dt_s), (len(grid_s) - 1) // 2)
    smooth, rate = np.empty_like(q_rad), np.empty_like(q_rad)
    for joint in range(q_rad.shape[1]):
        fits = _local_quadratics(np.interp(grid_s, t_s, q_rad[:, joint]), half)
        smooth[:, joint] = np.interp(t_s, grid_s, fits[0])
        rate[:, joint] = np.interp(t_s, grid_s, fits[1] / dt_s)
    return smooth, rate


def _local_quadratics(values: Array, half: int) -> tuple[Array, Array]:
    """Return value and slope per sample of the quadratic fitted around each sample."""
    offsets = np.arange(-half, half + 1, dtype=np.float64)
    solver = np.linalg.pinv(np.vander(offsets, 3, increasing=True))
    windows = np.lib.stride_tricks.sliding_window_view(values, 2 * half + 1)
    level, slope, bend = solver @ windows.T
    centre = np.clip(np.arange(len(values)), half, len(values) - 1 - half)
    x, at = np.arange(len(values)) - centre, centre - half
    return level[at] + slope[at] * x + bend[at] * x * x, slope[at] + 2.0 * bend[at] * x
