"""The emulated robot: one arm, a servo and an amplifier node per joint, and emulated time.

Every 500 us each current loop runs and the arm advances under its mean torques; every second
time the nodes' timers tick. In lockstep a SYNC, once all nodes have latched and answered it,
advances everything by one period; otherwise the caller passes the wall's time on. An arm on several
buses takes a SYNC from each of them for one period.
"""

from collections.abc import Sequence

from drivers.fault_frame import FAULT_ID, parse_fault
from drivers.frame import ERR_FLAG, FRAME_SIZE, LOCKSTEP_ID, RTR_FLAG, is_fd, unpack_frame
from sim_backend.arm import Arm
from sim_backend.chain import CURRENT_LOOP_PERIOD_NS
from sim_backend.errors import SimError
from sim_backend.faults import Faults
from sim_backend.node import AmplifierNode
from sim_backend.servo import CURRENT_LOOP_PERIOD_S, Servo
from sim_backend.settings import FaultSettings

SYNC_ID = 0x080
TICK_S = 1e-3
TICKS_AHEAD_MAX = 8
"""A bus without SYNC holds up emulated time no longer than this, in periods."""
_NOT_DATA = RTR_FLAG | ERR_FLAG


class Emulator:
    """Everything behind the wire.

    If the plant's settings say so, the arm is held at its start pose until the first servo is
    energised, and never again after that.

    Args:
        arm: The plant.
        servos: One per joint, shoulder first.
        nodes: The amplifiers that command these servos, in any order.
        is_lockstep: SYNC advances time. May be changed at any instant.
        faults: Through which the nodes send (`Faults.output`); left out, there are no faults on
            the frames that they send. Needs one node per joint, shoulder first.
        places: Bus (from 0) of each node, in the order of `nodes`; left out, all are on one.

    Attributes:
        is_lockstep: See above.
        q_true_rad: The plant's joint angles, of the links, at the last SYNC, when the encoders
            were latched.
        dq_true_rad_s: The plant's joint rates at the last SYNC.
        tau_applied_Nm: Mean motor torque per joint over the last whole period of 1 ms.

    Raises:
        SimError: If the number of servos or nodes is not the number of joints.
    """

    __slots__ = (
        "_arm",
        "_cyclic_nodes",
        "_faults",
        "_fd_nodes",
        "_first_half_Nm",
        "_has_period_begun",
        "_is_waiting",
        "_nodes",
        "_nodes_on",
        "_places",
        "_remainder_ns",
        "_remote_nodes",
        "_sense",
        "_servos",
        "_ticks",
        "dq_true_rad_s",
        "is_lockstep",
        "q_true_rad",
        "tau_applied_Nm",
    )

    def __init__(
        self,
        arm: Arm,
        servos: Sequence[Servo],
        nodes: Sequence[AmplifierNode],
        *,
        is_lockstep: bool,
        faults: Faults | None = None,
        places: Sequence[int] = (),
    ) -> None:
        count = len(arm.q_rad)
        if len(servos) != count or len(nodes) != count:
            raise SimError(
                f"an arm of {count} joints needs {count} servos and nodes:"
                f" got {len(servos)} and {len(nodes)}"
            )
        self._arm, self._servos, self._nodes = arm, tuple(servos), tuple(nodes)
        self._cyclic_nodes = [
            n for n in nodes if type(n).begin_period is not AmplifierNode.begin_period
        ]
        self._places = tuple(places) or (0,) * count
        self._nodes_on = [
            [n for n, place in zip(nodes, self._places, strict=True) if place == bus]
            for bus in range(max(self._places) + 1)
        ]
        self._fd_nodes = [[n for n in on_bus if n.takes_fd] for on_bus in self._nodes_on]
        self._remote_nodes = [
            [n for n in on_bus if n.takes_remote_requests] for on_bus in self._nodes_on
        ]
        self._ticks = [0] * len(self._nodes_on)
        self._has_period_begun = False
        self.is_lockstep = is_lockstep
        self._faults = faults or Faults(FaultSettings(), servos, [_lose] * count)
        self._faults.connect(nodes, self._reach_nodes)
        self._is_waiting = arm.settings.is_held_until_enabled
        if self._is_waiting:
            arm.hold()
        else:
            self._faults.start_schedule(0)
        self._remainder_ns = 0
        self._first_half_Nm: list[float] | None = None
        self.tau_applied_Nm = [0.0] * count
        self._sense = self._sense_drivetrains if arm.has_drivetrain else self._sense_joints
        self._sense()
        self._latch_truth()

    @property
    def arm(self) -> Arm:
        """The plant, to hand it payloads and disturbances by call."""
        return self._arm

    @property
    def time_ns(self) -> int:
        """Emulated time since the arm's reset."""
        return self._arm.time_ns

    def power_on(self) -> None:
        """Switch every amplifier on; each announces itself."""
        for node in self._nodes:
            node.power_on()

    def receive(self, frame: bytes, bus: int = 0) -> None:
        """Take one frame from the wire.

        Error reports are ignored; CAN FD frames and remote requests are for the nodes that take
        them. In lockstep a SYNC advances one period after the nodes have answered it; with several
        buses, the SYNC that completes the period on all of them.

        Args:
            frame: Record of either size (`drivers.frame`).
            bus: The bus it came on, from 0.

        Raises:
            PlantError: If the arm broke down while advancing.
        """
        if not self._faults.is_quiet:
            self._receive_through_faults(frame, bus)
            return
        if len(frame) != FRAME_SIZE:
            if is_fd(frame):
                self._receive_fd(frame, bus)
            return
        can_id, data = unpack_frame(frame)
        if can_id & _NOT_DATA:
            self._receive_remote(can_id, data, bus)
            return
        if can_id == FAULT_ID:
            self._take_fault(data)
            return
        if can_id != SYNC_ID and can_id != LOCKSTEP_ID:  # noqa: PLR1714 - every frame
            for node in self._nodes_on[bus]:
                node.receive(can_id, data)
            return
        self._latch_truth()
        for node in self._nodes_on[bus]:
            node.receive(can_id, data)
        if self.is_lockstep and self._take_tick(bus):
            self._begin_period()
            self.advance_period()

    def leave_lockstep(self) -> None:
        """Let time run by the clock; a SYNC that waited for those of other buses is forgotten."""
        self.is_lockstep = self._has_period_begun = False
        self._ticks = [0] * len(self._ticks)

    def _take_tick(self, bus: int) -> bool:
        """Count a SYNC in lockstep; True if time is to go on, one period for one of every bus.

        Buses are read in any order, so that one may be ahead. One that stays behind has lost a
        SYNC, or its master: it is waited for `TICKS_AHEAD_MAX` periods in all, not in each.
        """
        ticks = self._ticks
        if len(ticks) == 1:
            return True
        ticks[bus] += 1
        if not all(ticks) and ticks[bus] <= TICKS_AHEAD_MAX:
            return False
        self._ticks = [max(0, count - 1) for count in ticks]
        return True

    def _receive_remote(self, can_id: int, data: bytes, bus: int) -> None:
        if not can_id & ERR_FLAG:
            for node in self._remote_nodes[bus]:
                node.receive(can_id, data)

    def _receive_fd(self, frame: bytes, bus: int) -> None:
        can_id, data = unpack_frame(frame)
        if not can_id & _NOT_DATA:
            for node in self._fd_nodes[bus]:
                node.receive(can_id, data)

    # --- faults -------------------------------------------------------------------------------

    def _take_fault(self, data: bytes) -> None:
        order = parse_fault(data)
        if order is not None:
            self._faults.take(order, self._period)

    def _receive_through_faults(self, frame: bytes, bus: int) -> None:
        """Do as `receive` does, while a fault acts: time goes on even if nobody hears its tick."""
        can_id, data = unpack_frame(frame)
        if can_id == FAULT_ID:
            self._take_fault(data)
            return
        is_tick = can_id in (SYNC_ID, LOCKSTEP_ID)
        if is_tick:
            self._latch_truth()
            if self.is_lockstep and not self._has_period_begun:
                self._has_period_begun = True
                self._faults.begin_period(is_lockstep=True)
        self._faults.send_from_host(frame, bus)
        if is_tick and self.is_lockstep and self._take_tick(bus):
            self._begin_period()
            self.advance_period()

    def _reach_nodes(self, bus: int, frame: bytes) -> None:
        """Hand a frame that has come through to the bus's nodes that take such, and hear."""
        can_id, data = unpack_frame(frame)
        if can_id & ERR_FLAG:
            return
        for joint, node in enumerate(self._nodes):
            is_for_it = (
                self._places[joint] == bus
                and (node.takes_fd or not is_fd(frame))
                and (node.takes_remote_requests or not can_id & RTR_FLAG)
            )
            if is_for_it and not self._faults.is_deaf(joint):
                node.receive(can_id, data)

    @property
    def _period(self) -> int:
        """Number of the present period of 1 ms since power-on."""
        return self._arm.time_ns // 1_000_000

    # --- time ---------------------------------------------------------------------------------

    def advance_period(self) -> None:
        """Advance by 1 ms: two current-loop periods.

        Raises:
            PlantError: If the arm broke down.
        """
        self._has_period_begun = False
        self._run_current_loop()
        self._run_current_loop()

    def advance(self, duration_ns: int) -> None:
        """Advance by elapsed time; what does not fill a current-loop period is kept for later.

        Args:
            duration_ns: At least 0.

        Raises:
            SimError: If `duration_ns` is negative. Nothing has moved.
            PlantError: If the arm broke down.
        """
        if duration_ns < 0:
            raise SimError(f"emulated time cannot run backwards: advance({duration_ns} ns)")
        periods, self._remainder_ns = divmod(
            self._remainder_ns + duration_ns, CURRENT_LOOP_PERIOD_NS
        )
        for _ in range(periods):
            self._run_current_loop()

    def _run_current_loop(self) -> None:
        """Advance by 500 us, and tick the nodes if that completes a period."""
        servos, arm, faults = self._servos, self._arm, self._faults
        tau_Nm = [servo.drive() for servo in servos] if faults.is_quiet else faults.drive()
        if self._is_waiting and any(servo.is_energised for servo in servos):
            self._is_waiting = False
            arm.release()
            faults.start_schedule(self._period)
        arm.step(tau_Nm, CURRENT_LOOP_PERIOD_S)
        self._sense()
        if not faults.is_quiet:
            faults.distort()
        first = self._first_half_Nm
        if first is None:
            self._first_half_Nm = tau_Nm
            return
        self._first_half_Nm = None
        self.tau_applied_Nm = [0.5 * (a + b) for a, b in zip(first, tau_Nm, strict=True)]
        for node in self._nodes:
            node.tick(TICK_S)
        if not faults.is_idle:
            faults.end_period(self._period)
            if not self.is_lockstep:
                faults.begin_period(is_lockstep=False)
        if not self.is_lockstep:
            self._begin_period()

    def _begin_period(self) -> None:
        for node in self._cyclic_nodes:
            node.begin_period()

    def _sense_joints(self) -> None:
        arm = self._arm
        for servo, q_rad, dq_rad_s in zip(self._servos, arm.q_rad, arm.dq_rad_s, strict=True):
            servo.sense(q_rad, dq_rad_s)

    def _sense_drivetrains(self) -> None:
        """Each encoder reads its side; the winding always feels the rotor."""
        arm = self._arm
        rates = arm.dq_motor_rad_s
        encoders = zip(self._servos, *arm.encoder_motion(), rates, strict=True)
        for servo, q_rad, dq_rad_s, motor_rad_s in encoders:
            servo.sense(q_rad, dq_rad_s, motor_rad_s)

    def _latch_truth(self) -> None:
        # The arm makes new lists at every step, so these stay what they are.
        self.q_true_rad, self.dq_true_rad_s = self._arm.q_rad, self._arm.dq_rad_s


def _lose(_frame: bytes) -> None:
    """Take what nobody waits for."""
