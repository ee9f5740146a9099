"""An arm behind ideal amplifiers: no frames, no counts; to measure the law, not the platform."""

import math
from collections.abc import Sequence

from drivers.axis import Axis, AxisInfo, AxisStatus, FrameHandler, Port
from sim_backend.arm import Arm

TORQUE_LAG_S = 0.5e-3
TORQUE_DELAY_S = 0.5e-3
_STEP_S = 250e-6


class _IdealAxis(Axis):
    """True position and velocity; power at once."""

    def __init__(self, joint: int) -> None:
        super().__init__(f"joint {joint} (ideal)")
        self.dq_rad_s = 0.0
        self.age_cycles = 0

    def configure(self, port: Port) -> AxisInfo:
        del port
        return AxisInfo("ideal", 0.0, 0.0, is_lockstep=True)

    def start(self, port: Port) -> None:
        del port

    def handlers(self) -> dict[int, FrameHandler]:
        return {}

    def command(self, tau_Nm: float) -> bytes:
        del tau_Nm
        return b""

    def enable(self) -> None:
        self.status = AxisStatus.ENABLED

    def disable(self) -> None:
        self.status = AxisStatus.DISABLED

    def reset_fault(self) -> None:
        pass

    def end_cycle(self) -> None:
        pass


class IdealArm:
    """The `ArmLink` of scenario A0: torque follows its command after a delay, with a lag.

    Attributes:
        axes: One per joint, shoulder first.
        q_true_rad: Joint angles at the start of the cycle.
        dq_true_rad_s: Joint rates then.
        tau_applied_Nm: Mean torque over the period that began then.
    """

    def __init__(self, arm: Arm, period_s: float) -> None:
        joints = len(arm.q_rad)
        self.axes: Sequence[Axis] = [_IdealAxis(j) for j in range(1, joints + 1)]
        self.q_true_rad = list(arm.q_rad)
        self.dq_true_rad_s = list(arm.dq_rad_s)
        self.tau_applied_Nm = [0.0] * joints
        self.age_cycles = 0
        self._arm = arm
        self._steps = round(period_s / _STEP_S)
        self._delay_steps = round(TORQUE_DELAY_S / _STEP_S)
        ratio = _STEP_S / TORQUE_LAG_S
        self._decay = math.exp(-ratio)
        self._mean = (1.0 - self._decay) / ratio
        self._demand_Nm = [0.0] * joints
        self._torque_Nm = [0.0] * joints

    def request_feedback(self) -> None:
        """Latch the plant's motion."""
        self.q_true_rad, self.dq_true_rad_s = list(self._arm.q_rad), list(self._arm.dq_rad_s)

    def collect(self, deadline_ns: int) -> bool:
        """Hand the latched motion to the axes."""
        del deadline_ns
        for axis, q, dq in zip(self.axes, self.q_true_rad, self.dq_true_rad_s, strict=True):
            axis.q_rad, axis.dq_rad_s = q, dq
        return True

    def send_torques(self, tau_Nm: Sequence[float]) -> None:
        """Advance the plant one period under the old demand, then under this one."""
        mean = [0.0] * len(self.axes)
        for step in range(self._steps):
            demand = self._demand_Nm if step < self._delay_steps else tau_Nm
            applied = self._lag(demand)
            self._arm.step(applied, _STEP_S)
            mean = [a + b / self._steps for a, b in zip(mean, applied, strict=True)]
        self._demand_Nm = list(tau_Nm)
        self.tau_applied_Nm = mean

    def _lag(self, demand_Nm: Sequence[float]) -> list[float]:
        before = self._torque_Nm
        self._torque_Nm = [
            d + (b - d) * self._decay for d, b in zip(demand_Nm, before, strict=True)
        ]
        return [d + (b - d) * self._mean for d, b in zip(demand_Nm, before, strict=True)]

    def inject_fault(self, joint: int) -> bool:
        """Ideal amplifiers have no faults."""
        del joint
        return False

    def send_fault(self, frame: bytes) -> bool:
        """There is no bus to ask an emulator over."""
        del frame
        return False

    @property
    def is_enabled(self) -> bool:
        """True if every axis applies torque."""
        return all(axis.status is AxisStatus.ENABLED for axis in self.axes)

    def first_in(self, status: AxisStatus) -> Axis | None:
        """Return the first axis with this status, None if there is none."""
        return next((axis for axis in self.axes if axis.status is status), None)
