"""Writes one `Sample` per cycle from the controller's state."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

from hil.control import ArmLink, Control
from hil.telemetry import Buffer, SampleLayout

Truth = Callable[[], tuple[Sequence[float], Sequence[float], Sequence[float]]]
"""Plant's joint angles, rates and applied torques of this cycle (simulation only)."""
MAX_STAMP_NS = (1 << 31) - 1


class Stamps(NamedTuple):
    """Timing of one cycle in ns; instants are relative to its scheduled start."""

    wake_late_ns: int = 0
    feedback_ns: int = 0
    law_ns: int = 0
    sent_ns: int = 0
    busy_ns: int = 0


class Sampler:
    """Serialises the samples of one run, numbered without gaps."""

    def __init__(
        self, layout: SampleLayout, control: Control, bus: ArmLink, truth: Truth | None = None
    ) -> None:
        self.seq = 0
        self._write = layout.writer()
        self._control = control
        self._bus = bus
        self._truth = truth

    def write(
        self, buffer: Buffer, offset: int, cycle: tuple[int, int, int], stamps: Stamps
    ) -> None:
        """Serialise the cycle that has just been run into `buffer`.

        Args:
            buffer: Where to write.
            offset: First byte.
            cycle: Period number, scheduled start in ns, and skipped periods so far.
            stamps: Its timing.
        """
        control, law, axes = self._control, self._control.law, self._bus.axes
        number, t_ns, overruns = cycle
        machine, player, gains = control.machine, control.player, law.gains
        monitor = control.monitor
        scalars = (
            self.seq,
            number,
            t_ns,
            machine.state,
            machine.fault,
            self._bus.age_cycles,
            overruns,
            *stamps,
            player.t_ref_s,
            monitor.V_rad2_s2,
            monitor.dissipation_W,
            monitor.demand_W,
            monitor.dissipation_W > monitor.demand_W,
        )
        setpoint = player.setpoint
        lists: tuple[Sequence[float], ...] = (
            control.q_rad,
            control.dq_rad_s,
            setpoint.q_rad,
            setpoint.dq_rad_s,
            law.S,
            law.sigma,
            law.Kd,
            [gain.Kd_min for gain in gains],
            [gain.Kd_max for gain in gains],
            control.tau_cmd_Nm,
            control.tau_sent_Nm,
            [axis.tau_meas_Nm for axis in axes],
            monitor.in_Omega_Kd,
            monitor.entries,
            monitor.exits,
            monitor.tau_need_Nm,
            monitor.S_bound_rad_s,
        )
        if self._truth is not None:
            lists += self._truth()
        self._write(buffer, offset, scalars, lists)
        self.seq += 1
