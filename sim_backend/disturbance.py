"""Disturbance torques by schedule: their mean over each substep, without sampling error."""

from collections.abc import Sequence
from math import cos, tau

from sim_backend.settings import DisturbanceSettings

_FOREVER_NS = 1 << 62


class Disturbances:
    """The torques of a schedule.

    Args:
        settings: The schedule.
        joints: Number of joints.
    """

    __slots__ = ("_constant", "_edges_ns", "_joints", "_sines")

    def __init__(self, settings: Sequence[DisturbanceSettings], joints: int) -> None:
        self._joints = joints
        self._edges_ns: list[int] = []
        self._constant: list[tuple[int, int, int, float]] = []
        self._sines: list[tuple[int, int, int, float, float]] = []
        for each in settings:
            start_ns = round(each.start_s * 1e9)
            end_ns = _FOREVER_NS if each.end_s is None else round(each.end_s * 1e9)
            self._edges_ns += (start_ns, end_ns)
            span = (each.joint - 1, start_ns, end_ns, each.torque_Nm)
            if each.frequency_Hz is None:
                self._constant.append(span)
            else:
                self._sines.append((*span, tau * each.frequency_Hz * 1e-9))

    def mean_Nm(self, from_ns: int, to_ns: int) -> list[float]:
        """Return the mean torque per joint between two instants, exactly.

        Args:
            from_ns: Time the arm has been free to move.
            to_ns: The same, later.
        """
        mean_Nm = [0.0] * self._joints
        length_ns = to_ns - from_ns
        for joint, start_ns, end_ns, torque_Nm in self._constant:
            low, high = max(start_ns, from_ns), min(end_ns, to_ns)
            if high > low:
                mean_Nm[joint] += torque_Nm * ((high - low) / length_ns)
        for joint, start_ns, end_ns, torque_Nm, per_ns in self._sines:
            low, high = max(start_ns, from_ns), min(end_ns, to_ns)
            if high > low:
                change = cos(per_ns * (low - start_ns)) - cos(per_ns * (high - start_ns))
                mean_Nm[joint] += torque_Nm * change / (per_ns * length_ns)
        return mean_Nm

    def steady_until_ns(self, now_ns: int) -> int:
        """Return until when the torques stay as they are just after `now_ns`."""
        if any(start_ns <= now_ns < end_ns for _, start_ns, end_ns, *_ in self._sines):
            return now_ns
        return min((edge for edge in self._edges_ns if edge > now_ns), default=_FOREVER_NS)
