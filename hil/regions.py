"""What a run shows of the paper's claims on S: regions, decay, ultimate bound, dissipation.

Where the plant's truth is recorded, S is taken from the plant's own motion; what the law and its
monitors saw, with the noise of the velocity estimate in it, is told beside it.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from controller.model_based import PlanarChain, parameters
from controller.monitor import OMEGA_KD_RAD_S
from controller.settings import LinkModel, ModelSettings
from hil.decay import has_truth, noise_free_manifold
from hil.fixed_protobuf import Records

Array = NDArray[np.float64]
PerJoint = tuple[float, ...]
Powers = tuple[Array, Array]

_DECAYED_SHARE: Final = 0.1  # of |S(0)|
_SMALLEST_S0_rad_s: Final = 0.1
_FEWEST_POINTS: Final = 5


@dataclass(frozen=True, slots=True)
class Decay:
    """How S falls from its initial value to a tenth of it; NaN where it starts small or stays.

    Attributes:
        duration_s: First time below a tenth.
        rate_1_s: r of |S| = c exp(-r t), least squares of ln |S| over that time.
        level_rad_s: c.
        r_squared: Share of the variance of ln |S| that the exponential explains.
    """

    duration_s: PerJoint
    rate_1_s: PerJoint
    level_rad_s: PerJoint
    r_squared: PerJoint


@dataclass(frozen=True, slots=True)
class Regions:
    """Omega_Kd (|S_j| < 1 rad/s) and the bound S ends in; tuples have one entry per joint.

    Attributes:
        entered_s: First time in Omega_Kd; 0 if S starts there, NaN if it never comes.
        entries: Into Omega_Kd during the trajectory, of S without noise.
        exits: Likewise.
        counted_entries: The same as the monitor counted them, with noise.
        counted_exits: Likewise.
        bound_rad_s: Largest |S| of the steady state, without noise.
        seen_bound_rad_s: The same as the law saw it.
        load_bound_rad_s: Largest |tau_need / Kd| there: where tau = -Kd S must let S settle.
    """

    entered_s: PerJoint
    entries: PerJoint
    exits: PerJoint
    counted_entries: PerJoint
    counted_exits: PerJoint
    bound_rad_s: PerJoint
    seen_bound_rad_s: PerJoint
    load_bound_rad_s: PerJoint


@dataclass(frozen=True, slots=True)
class Balance:
    """S'Kd S against |S' Y_r Theta| (36) over one part of a run, in means.

    Attributes:
        dissipation_W: S'Kd S as the law saw it.
        demand_W: The monitor's estimate of |S' Y_r Theta|.
        share: Of cycles in which (36) holds by these two.
        model_dissipation_W: S'Kd S without noise; NaN where the plant is not known.
        model_demand_W: |S' Y_r Theta| with the plant's own parameters; likewise.
        model_share: Of cycles in which (36) holds by these two; likewise.
    """

    dissipation_W: float
    demand_W: float
    share: float
    model_dissipation_W: float = math.nan
    model_demand_W: float = math.nan
    model_share: float = math.nan


@dataclass(frozen=True, slots=True)
class ManifoldFigures:
    """What `measure_manifold` finds.

    Attributes:
        decay: Of the initial error.
        regions: Over the whole run, and the bound of its steady state.
        decaying: Balance until every joint has decayed; None if none does.
        steady: Balance of the steady state.
        S: Error manifold without noise, one column per joint.
        powers: S'Kd S and |S' Y_r Theta| per row in W, without noise and by the plant's own
            parameters; None where the plant is not known.
    """

    decay: Decay
    regions: Regions
    decaying: Balance | None
    steady: Balance
    S: Array
    powers: Powers | None


def has_monitors(rows: Records) -> bool:
    """Tell whether the rows carry the monitors (recordings of earlier releases do not)."""
    names = rows.dtype.names or ()
    return "in_Omega_Kd" in names and bool(np.isfinite(rows["in_Omega_Kd"]).all())


def measure_manifold(
    rows: Records, stat_start_s: float, plant: ModelSettings | None = None
) -> ManifoldFigures:
    """Take the figures of one trajectory.

    Args:
        rows: As `hil.metrics.trajectory_rows` returns them, with monitors.
        stat_start_s: Start of the steady state.
        plant: The simulated plant's parameters, if they are known.
    """
    t_s = np.asarray(rows["t_ref_s"], dtype=np.float64)
    S = noise_free_manifold(rows)
    steady = t_s >= stat_start_s
    decay = fit_decay(t_s, S)
    powers = None if plant is None or not has_truth(rows) else model_powers(rows, S, plant)
    ends = [end for end in decay.duration_s if math.isfinite(end)]
    return ManifoldFigures(
        decay=decay,
        regions=_regions(rows, S, steady),
        decaying=_balance(rows, t_s <= max(ends), powers) if ends else None,
        steady=_balance(rows, steady, powers),
        S=S,
        powers=powers,
    )


def fit_decay(t_s: Array, S: Array) -> Decay:
    """Fit an exponential to |S| of every joint until it is below a tenth of where it starts.

    Args:
        t_s: Rising instants from 0.
        S: One column per joint, free of noise.
    """
    fits = [_fit_joint(t_s, np.abs(column)) for column in S.T]
    return Decay(*zip(*fits, strict=True))


def _fit_joint(t_s: Array, size: Array) -> tuple[float, float, float, float]:
    below = np.flatnonzero(size < _DECAYED_SHARE * size[0])
    if size[0] <= _SMALLEST_S0_rad_s or not len(below) or below[0] < _FEWEST_POINTS:
        return math.nan, math.nan, math.nan, math.nan
    t, log = t_s[: below[0]], np.log(size[: below[0]])
    slope, level = np.polyfit(t, log, 1)
    residual = float(np.sum((log - level - slope * t) ** 2))
    spread = float(np.sum((log - log.mean()) ** 2))
    explained = 1.0 - residual / spread if spread > 0.0 else math.nan
    return float(t_s[below[0]]), -float(slope), math.exp(level), explained


def _regions(rows: Records, S: Array, steady: NDArray[np.bool_]) -> Regions:
    inside = np.abs(S) < OMEGA_KD_RAD_S
    crossings = np.diff(inside.astype(np.int8), axis=0)
    first = [np.flatnonzero(column) for column in inside.T]
    load = np.abs(rows["tau_need_Nm"][steady] / rows["Kd"][steady])
    return Regions(
        entered_s=tuple(float(rows["t_ref_s"][at[0]]) if len(at) else math.nan for at in first),
        entries=_per_joint((crossings > 0).sum(axis=0)),
        exits=_per_joint((crossings < 0).sum(axis=0)),
        counted_entries=_per_joint(np.ptp(rows["Omega_Kd_entries"], axis=0)),
        counted_exits=_per_joint(np.ptp(rows["Omega_Kd_exits"], axis=0)),
        bound_rad_s=_per_joint(np.abs(S[steady]).max(axis=0)),
        seen_bound_rad_s=_per_joint(np.abs(rows["S_rad_s"][steady]).max(axis=0)),
        load_bound_rad_s=_per_joint(load.max(axis=0)),
    )


def _balance(rows: Records, part: NDArray[np.bool_], powers: tuple[Array, Array] | None) -> Balance:
    seen = (
        float(np.mean(rows["dissipation_W"][part])),
        float(np.mean(rows["demand_W"][part])),
        float(np.mean(rows["is_dissipating"][part])),
    )
    if powers is None:
        return Balance(*seen)
    dissipation, demand = powers[0][part], powers[1][part]
    share = float(np.mean(dissipation > demand))
    return Balance(*seen, float(np.mean(dissipation)), float(np.mean(demand)), share)


def model_powers(rows: Records, S: Array, plant: ModelSettings) -> Powers:
    """Return S'Kd S and |S' Y_r Theta| per row, in W, from the plant's own motion.

    dq_r = dq - S by (4), so that the law need not be known. Source: (2), (36). Friction acts on
    dq, in (2) it stands for dq_r: (3) leaves out S'B S, which also dissipates, and where S is
    large even a steady state has S'Kd S below this demand.
    """
    chain, Theta = PlanarChain(plant), np.array(parameters(plant))
    q, dq = rows["q_true_rad"], rows["dq_true_rad_s"]
    dq_r = dq - S
    ddq_r = np.gradient(dq_r, rows["t_ref_s"], axis=0)
    motion = (column.tolist() for column in (q, dq, dq_r, ddq_r))
    torque = np.array(
        [np.array(chain.regressor(*row)) @ Theta for row in zip(*motion, strict=True)]
    )
    return (rows["Kd"] * S**2).sum(axis=1), np.abs((S * torque).sum(axis=1))


def plant_of(config: Mapping[str, Any]) -> ModelSettings | None:
    """Return what a recorded configuration says of the simulated plant as a chain with friction.

    None if it says nothing. Payload, disturbances, backlash and Stribeck are not in it.
    """
    plant = config.get("plant")
    if not isinstance(plant, Mapping) or not plant.get("links"):
        return None
    links = [{name: link[name] for name in LinkModel.model_fields} for link in plant["links"]]
    rest = {name: plant[name] for name in ModelSettings.model_fields if name != "links"}
    return ModelSettings.model_validate({"links": links, **rest})


def _per_joint(values: NDArray[Any]) -> PerJoint:
    return tuple(float(value) for value in values)
