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

    In simulation S is built from the plant's own position and rate; otherwise from the encoder's
    position smoothed without lag. Either way alpha and Ki are those the recorded S was made with.
    """
    S = np.abs(_noise_free_manifold(rows))
    t_s = rows["t_ref_s"]
    rates = np.full(S.shape[1], np.nan)
    for joint, column in enumerate(S.T):
        settled = np.flatnonzero(column < _SETTLED_SHARE * column[0])
        if len(settled) and column[0] > _SMALLEST_S0_rad_s and t_s[settled[0]] > 0.0:
            rates[joint] = math.log(10.0) / t_s[settled[0]]
    return rates


def _noise_free_manifold(rows: Records) -> Array:
    if has_truth(rows):
        q, dq = rows["q_true_rad"], rows["dq_true_rad_s"]
    else:
        q, dq = smoothed_motion(rows["t_ref_s"], rows["q_meas_rad"])
    S = np.array(rows["S_rad_s"], dtype=np.float64)
    for joint in range(S.shape[1]):
        error = rows["q_meas_rad"][:, joint] - rows["q_des_rad"][:, joint]
        rate_error = rows["dq_meas_rad_s"][:, joint] - rows["dq_des_rad_s"][:, joint]
        # S = dq_err + alpha q_err + Ki sigma, paper (6), (7): exact, so two gains are found exactly
        terms = np.column_stack((error, rows["sigma"][:, joint]))
        alpha = np.linalg.lstsq(terms, S[:, joint] - rate_error)[0][0]
        S[:, joint] += dq[:, joint] - rows["dq_meas_rad_s"][:, joint]
        S[:, joint] += alpha * (q[:, joint] - rows["q_meas_rad"][:, joint])
    return S


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
