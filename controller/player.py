"""Plays a compiled reference: the loop only indexes; a stop slows down along the path."""

from array import array
from collections.abc import Sequence
from struct import Struct
from typing import NamedTuple

SHORTEST_STOP_PERIODS = 10
STOP_ROUNDS = 8
"""Attempts at a stop's duration; the path ahead may be faster than where the stop begins."""
_STOP_SHAPE = tuple(
    (x - x**4 * (2.5 - 3.0 * x + x * x), 30.0 * (x * (1.0 - x)) ** 2)
    for x in (eighth / 8.0 for eighth in range(1, 8))
)
"""Way covered and slowing in a stop of duration one from speed one, at seven instants of it."""


class Setpoint(NamedTuple):
    """Reference of one cycle, per joint."""

    q_rad: Sequence[float]
    dq_rad_s: Sequence[float]
    ddq_rad_s2: Sequence[float]


class ReferencePlayer:
    """The reference in force: a pose that is held, or a compiled motion being indexed.

    A motion is a flat view of doubles, one row a period: q, dq, ddq of all joints.

    Attributes:
        setpoint: The reference of the last step.
        t_ref_s: Time along the running motion, 0 when none runs.
    """

    def __init__(self, joints: int, period_s: float) -> None:
        self._joints = joints
        self._period_s = period_s
        self._rows: memoryview | None = None
        self._read_row = Struct(f"={3 * joints}d").unpack_from
        self._last = 0
        self._phase = 0.0
        self._speed = 1.0
        self._stop_elapsed_s = 0.0
        self._stop_duration_s = 0.0
        self.t_ref_s = 0.0
        zeros = [0.0] * joints
        self.setpoint = Setpoint(zeros, zeros, zeros)

    @property
    def is_moving(self) -> bool:
        """True while a motion is being played."""
        return self._rows is not None

    @property
    def is_stopping(self) -> bool:
        """True while a motion is being slowed down to rest."""
        return self._stop_duration_s > 0.0

    @property
    def index(self) -> int:
        """Row of the motion that was played last."""
        return int(self._phase)

    def hold(self, q_rad: Sequence[float]) -> None:
        """Drop any motion and hold a pose."""
        zeros = [0.0] * self._joints
        self.setpoint = Setpoint(list(q_rad), zeros, zeros)
        self._end()

    def start(self, rows: Sequence[float], samples: int, ahead: int = 1) -> None:
        """Play a motion from its first row, which the next step returns.

        Args:
            rows: Flat doubles, `samples` rows of q, dq, ddq for all joints; a view of doubles is
                kept, anything else is copied.
            samples: Number of rows, at least 1.
            ahead: Periods from now to the first row, at least 1. The next step is at least as
                long; if it is longer, it returns the row that is due by then.
        """
        self._end()
        self._rows = rows if isinstance(rows, memoryview) else memoryview(array("d", rows))
        self._last = samples - 1
        self._phase = -float(ahead)

    def stop(self, ddq_max_rad_s2: Sequence[float]) -> None:
        """Slow down along the path, so that braking alone stays within these accelerations."""
        if self._rows is None or self.is_stopping:
            return
        duration_s = SHORTEST_STOP_PERIODS * self._period_s
        for attempt in range(STOP_ROUNDS):
            excess = self._braking(duration_s, ddq_max_rad_s2)
            if excess <= 1.0:
                break
            duration_s *= excess * excess if attempt else excess
        self._stop_duration_s = duration_s
        self._stop_elapsed_s = 0.0

    def step(self, periods: int) -> Setpoint:
        """Advance by whole periods and return the reference of this cycle.

        Args:
            periods: 1, or more after skipped periods. A motion that has ended holds its last row.
        """
        if self._rows is None:
            return self.setpoint
        if self.is_stopping:
            return self._step_stopping(periods)
        self._phase = min(self._phase + periods, float(self._last))
        self.t_ref_s = self._phase * self._period_s
        self.setpoint = self._row(int(self._phase))
        if self._phase >= self._last:
            self.hold(self.setpoint.q_rad)
        return self.setpoint

    def _braking(self, duration_s: float, ddq_max_rad_s2: Sequence[float]) -> float:
        """Return the largest share of its limit that braking takes up in a stop so long."""
        assert self._rows is not None  # noqa: S101 - only called while a motion is played
        n, worst = self._joints, 0.0
        for way, slowing in _STOP_SHAPE:
            row = min(int(self._phase + way * duration_s / self._period_s), self._last)
            start = row * 3 * n + n
            for dq, limit in zip(self._rows[start : start + n], ddq_max_rad_s2, strict=True):
                worst = max(worst, abs(dq) * slowing / (duration_s * limit))
        return worst

    def _step_stopping(self, periods: int) -> Setpoint:
        dt_s = periods * self._period_s
        before = self._speed
        self._stop_elapsed_s += dt_s
        x = min(1.0, self._stop_elapsed_s / self._stop_duration_s)
        self._speed = 1.0 - x * x * x * (10.0 - 15.0 * x + 6.0 * x * x)
        self._phase = min(self._phase + 0.5 * (before + self._speed) * periods, float(self._last))
        row = int(self._phase)
        q, dq, ddq = self._row(row)
        ahead_s = (self._phase - row) * self._period_s
        v, dv = self._speed, (self._speed - before) / dt_s
        path = [
            (a + ahead_s * (b + 0.5 * ahead_s * c), b + ahead_s * c, c)
            for a, b, c in zip(q, dq, ddq, strict=True)
        ]
        self.t_ref_s = self._phase * self._period_s
        self.setpoint = Setpoint(
            [a for a, _, _ in path],
            [b * v for _, b, _ in path],
            [c * v * v + b * dv for _, b, c in path],
        )
        if x >= 1.0 or self._phase >= self._last:
            self.hold(self.setpoint.q_rad)
        return self.setpoint

    def _row(self, index: int) -> Setpoint:
        assert self._rows is not None  # noqa: S101 - only called while a motion is played
        n = self._joints
        row = self._read_row(self._rows, 24 * n * index)
        return Setpoint(row[:n], row[n : 2 * n], row[2 * n :])

    def _end(self) -> None:
        self._rows = None
        self._speed = 1.0
        self._stop_duration_s = 0.0
        self.t_ref_s = 0.0
