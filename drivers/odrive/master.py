"""Master side of one ODrive axis in torque control over CANSimple."""

import math
from collections import deque

from drivers.axis import Axis, AxisInfo, AxisStatus, FrameHandler, Port
from drivers.errors import AmplifierError
from drivers.frame import pack_frame, unpack_frame
from drivers.odrive import codec
from drivers.odrive.codec import AxisError, AxisState, Command, Heartbeat
from drivers.odrive.endpoints import (
    EMULATED_SERIAL,
    INJECT_FAULT_ID,
    LAYOUT,
    Endpoint,
    EndpointTable,
)
from drivers.odrive.service import OdriveService, choose_table, refuse_unless_idle, shown
from drivers.odrive.settings import OdriveSettings

FORGIVEN_CYCLES = 10
"""After a reset, cycles within which a heartbeat may still tell of the old error."""
NEVER = -2
"""An age that feedback never has."""
SETTLED_CYCLES = 2
"""A heartbeat sooner after the request of a state may have been sent before it."""
VELOCITY_MAX_REV_S = 1e6
RESOLUTION_WORST_RAD = 5e-4
CURRENT_SLACK = 1.0 + 1e-4


class OdriveAxis(Axis):
    """One ODrive axis: torque 0x0E each cycle, encoder 0x09 polled or by the drive's clock.

    The drive applies a torque as soon as it has it, and keeps it until the next one or until its
    watchdog ends it. Its state comes with the heartbeat, every `heartbeat_ms`.
    """

    def __init__(self, settings: OdriveSettings, *, joint: int, period_s: float) -> None:
        super().__init__(f"joint {joint} (odrive node {settings.node_id})")
        self._settings = settings
        self._period_ms = max(1, round(period_s * 1e3))
        self.dq_rad_s: float = 0.0
        node, ratio = settings.node_id, settings.gear_ratio
        self._torque_max_motor_Nm = codec.f32_below(settings.torque_max_Nm / ratio)
        self._torque_max_Nm = self._torque_max_motor_Nm * ratio
        self._motor_per_joint = settings.direction / ratio
        self._joint_per_motor = settings.direction * ratio
        self._rad_per_rev = settings.direction * math.tau / ratio
        self._base_rad: float | None = None
        self._torque_head = pack_frame(codec.can_id(node, Command.INPUT_TORQUE), bytes(4))[:8]
        self._rest = self._frame(Command.INPUT_TORQUE, bytes(4))
        self._poll = self._frame(Command.ENCODER) if settings.feedback == "poll" else None
        self._idle = self._frame(Command.AXIS_STATE, codec.U32.pack(AxisState.IDLE))
        self._clear = self._frame(Command.CLEAR_ERRORS, b"\0")
        self._ask_errors = self._frame(Command.ERROR)
        self._power = self._power_frames()
        self._preparation: list[bytes] = []
        self._checks: dict[int, bytes] = {}
        self._unverified: dict[int, bytes] = {}
        self._queue: deque[bytes] = deque()
        self._wants_power = False
        self._is_preparing = False
        self._is_clean = False
        self._unsettled_cycles = SETTLED_CYCLES
        self._request_age = -1
        self._forgiven_cycles = 0
        self._age_at_end = NEVER
        self._heartbeat_limit = math.ceil(3e-3 * settings.heartbeat_ms / period_s)
        self._heartbeat_age = 0

    def _frame(self, command: Command, data: bytes = b"") -> bytes:
        return pack_frame(codec.can_id(self._settings.node_id, command), data)

    def _power_frames(self) -> list[bytes]:
        mode = codec.U32_PAIR.pack(codec.ControlMode.TORQUE, codec.INPUT_PASSTHROUGH)
        state = codec.U32.pack(AxisState.CLOSED_LOOP_CONTROL)
        return [
            self._frame(Command.CONTROLLER_MODE, mode),
            self._rest,
            self._frame(Command.AXIS_STATE, state),
        ]

    # --- start-up ---------------------------------------------------------------------------

    def configure(self, port: Port) -> AxisInfo:
        """Identify the drive, set limits, rates and watchdog and read them back."""
        s = self._settings
        service = OdriveService(port, s.node_id, self.label, s.reply_timeout_s)
        beat = service.wait_until_booted(s.heartbeat_ms)
        refuse_unless_idle(self.label, beat)
        service.refuse_other_master()
        version = service.version()
        serial = service.serial()
        is_lockstep = service.is_lockstep(serial)
        if s.parameters == "set":
            service.table = choose_table(self.label, s.endpoints_file, version)
            self._set_up(service)
        else:
            self._check_rates(service, is_lockstep=is_lockstep)
        if beat.errors == AxisError.WATCHDOG_TIMER_EXPIRED:  # nobody commanded it: no fault
            service.clear_errors()
        resolution_rad = self._resolution_rad(service)
        board, firmware = shown(version.hardware), shown(version.firmware)
        name = f"ODrive {board}, firmware {firmware}, serial {serial:012X}"
        torque_step_Nm = codec.f32_spacing(self._torque_max_motor_Nm) * s.gear_ratio
        is_emulated = serial & 0xFF_FFFF == EMULATED_SERIAL
        return AxisInfo(name, torque_step_Nm, resolution_rad, is_lockstep, is_emulated)

    def _set_up(self, service: OdriveService) -> None:
        values = self._values()
        for endpoint, value in values.items():
            service.set(endpoint, value)
        self._require_torque(service)
        self._plan_preparation(service.table, values)

    def _check_rates(self, service: OdriveService, *, is_lockstep: bool) -> None:
        service.require_rate(Command.HEARTBEAT, self._settings.heartbeat_ms, "heartbeat_ms")
        if self._poll is None and not is_lockstep:  # there it starts with the first cycle
            service.require_rate(Command.ENCODER, self._period_ms, "encoder_msg_rate_ms")

    def _values(self) -> dict[Endpoint, float]:
        """What the drive is told, in the order in which it is told."""
        s = self._settings
        return {
            Endpoint.HEARTBEAT_RATE: s.heartbeat_ms,
            Endpoint.ENCODER_RATE: 0 if s.feedback == "poll" else self._period_ms,
            Endpoint.TORQUES_RATE: s.torque_report_ms,
            Endpoint.TORQUE_SOFT_MAX: self._torque_max_motor_Nm,
            Endpoint.TORQUE_SOFT_MIN: -self._torque_max_motor_Nm,
            Endpoint.VEL_LIMIT: s.velocity_max_rad_s * s.gear_ratio / math.tau,
            Endpoint.TORQUE_MODE_VEL_LIMIT: False,
            Endpoint.WATCHDOG_TIMEOUT: s.watchdog_ms * 1e-3,
            Endpoint.ENABLE_WATCHDOG: True,
        }

    def _require_torque(self, service: OdriveService) -> None:
        constant_Nm_A = service.get(Endpoint.TORQUE_CONSTANT)
        current_A = service.get(Endpoint.CURRENT_SOFT_MAX)
        reach_Nm = constant_Nm_A * current_A * self._settings.gear_ratio
        if not reach_Nm * CURRENT_SLACK >= self._settings.torque_max_Nm:
            raise AmplifierError(
                f"{self.label}: its current limit of {current_A:g} A gives {reach_Nm:.4g} Nm at "
                f"the joint, torque_max_Nm is {self._settings.torque_max_Nm:g}; raise "
                f"{Endpoint.CURRENT_SOFT_MAX.value} or lower torque_max_Nm"
            )

    def _plan_preparation(self, table: EndpointTable, values: dict[Endpoint, float]) -> None:
        """Say all of it again before each enabling: a drive that restarted has forgotten it."""
        checked = (Endpoint.WATCHDOG_TIMEOUT, Endpoint.ENABLE_WATCHDOG)
        order = [*checked, *(endpoint for endpoint in values if endpoint not in checked)]
        self._preparation = [
            self._frame(Command.RX_SDO, table.write(endpoint, values[endpoint]))
            for endpoint in order
        ]
        self._preparation += [self._frame(Command.RX_SDO, table.read(end)) for end in checked]
        self._checks = {table.ids[end]: LAYOUT[end].pack(values[end]) for end in checked}

    def _resolution_rad(self, service: OdriveService) -> float:
        """Single precision gets coarse after many turns in one direction."""
        position_rev = service.position_rev()
        resolution_rad = codec.f32_spacing(position_rev) * abs(self._rad_per_rev)
        if resolution_rad > RESOLUTION_WORST_RAD:
            raise AmplifierError(
                f"{self.label}: at {position_rev:g} turns its position has steps of "
                f"{resolution_rad:.2g} rad (single precision), limit {RESOLUTION_WORST_RAD:g}; "
                "restart the drive near its home position"
            )
        return resolution_rad

    def start(self, port: Port) -> None:
        """Nothing: an idle axis takes torque 0 and answers."""
        del port

    # --- in operation -----------------------------------------------------------------------

    def handlers(self) -> dict[int, FrameHandler]:
        """Heartbeat, encoder, torques, errors and endpoint values of this node."""
        node = self._settings.node_id
        return {
            codec.can_id(node, Command.ENCODER): self._on_encoder,
            codec.can_id(node, Command.HEARTBEAT): self._on_heartbeat,
            codec.can_id(node, Command.TORQUES): self._on_torques,
            codec.can_id(node, Command.ERROR): self._on_errors,
            codec.can_id(node, Command.TX_SDO): self._on_value,
        }

    @property
    def is_asked(self) -> bool:
        """See `Axis.is_asked`: only with `feedback = "poll"`."""
        return self._poll is not None

    def request(self) -> bytes | None:
        """Ask for the encoder, unless the drive sends it by its own clock."""
        return self._poll

    def command(self, tau_Nm: float) -> bytes:
        """Torque 0x0E, or a request of another state; zero torque while it is not enabled.

        Zero torque is sent on to a drive that is not enabled: it feeds the watchdog, which some
        firmware counts down in IDLE too.
        """
        if self._queue:
            return self._take_request()
        if self.status is AxisStatus.ENABLED and self._wants_power:
            limit_Nm = self._torque_max_Nm
            if not -limit_Nm <= tau_Nm <= limit_Nm:
                tau_Nm = _clip(tau_Nm, limit_Nm)
            motor_Nm = tau_Nm * self._motor_per_joint
            return self._torque_head + codec.F32.pack(motor_Nm) + b"\0\0\0\0"
        if self._is_preparing and self._is_clean and not self._unverified:
            self._is_preparing = False
            self._queue.extend(self._power)
            return self._take_request()
        return self._rest

    def _take_request(self) -> bytes:
        frame = self._queue.popleft()
        if self._wants_power and not self._queue and not self._is_preparing:
            self._request_age = 0
        return frame

    def enable(self) -> None:
        """Ask for power: parameters once more, watchdog read back, 0x0B (1, 1), 0x07 = 8.

        The last of them wait for a heartbeat without errors, sent since the watchdog is fed.
        """
        self._wants_power = True
        self._request_age = -1
        self._is_preparing = True
        self._unverified = dict(self._checks)
        self._queue.extend(self._preparation)

    def disable(self) -> None:
        """Ask for torque off with the next command frame: 0x07 = 1."""
        is_clearing = self._clear in self._queue
        self._drop_power()
        self._queue.append(self._idle)
        if is_clearing:  # a reset is disabled right after it was asked for
            self._queue.append(self._clear)
        if self.status is AxisStatus.ENABLED:
            self.status = AxisStatus.DISABLED

    def _drop_power(self) -> None:
        self._wants_power = False
        self._is_preparing = False
        self._request_age = -1
        self._queue.clear()

    def reset_fault(self) -> None:
        """Ask for IDLE, then 0x18; also forgives a heartbeat that was lost."""
        self.status = AxisStatus.DISABLED
        self.disable()
        self._queue.append(self._clear)
        self._forgiven_cycles = FORGIVEN_CYCLES
        self._heartbeat_age = 0
        self.note = ""

    def end_cycle(self) -> None:
        """Count the silence since the last heartbeat."""
        if self._poll is None:
            self._age_at_end = self.age_cycles
        if self._request_age >= 0:
            self._request_age += 1
        if self._forgiven_cycles:
            self._forgiven_cycles -= 1
        if self._unsettled_cycles:
            self._unsettled_cycles -= 1
        self._heartbeat_age += 1
        if self._heartbeat_age > self._heartbeat_limit and self.status is not AxisStatus.LOST:
            self._lose(f"no heartbeat for {self._heartbeat_age} cycles")

    def _lose(self, reason: str) -> None:
        self.disable()
        self.status = AxisStatus.LOST
        self.note = f"{self.label}: {reason}"

    def inject_fault(self) -> bytes:
        """Write to an endpoint that only the emulated drive has; a real one ignores it."""
        write = codec.Sdo(codec.OPCODE_WRITE, INJECT_FAULT_ID, b"\x01")
        return self._frame(Command.RX_SDO, codec.pack_sdo(write))

    # --- feedback -----------------------------------------------------------------------------

    def _on_encoder(self, frame: bytes) -> bool:
        if frame[4] != codec.F32_PAIR.size:
            return False
        position_rev, velocity_rev_s = codec.F32_PAIR.unpack_from(frame, 8)
        if not (  # NaN included
            -codec.POSITION_MAX_REV <= position_rev <= codec.POSITION_MAX_REV
            and -VELOCITY_MAX_REV_S <= velocity_rev_s <= VELOCITY_MAX_REV_S
        ):
            return False
        if self._base_rad is None:
            self._base_rad = self._home(position_rev)
        self.q_rad = position_rev * self._rad_per_rev + self._base_rad
        self.dq_rad_s = velocity_rev_s * self._rad_per_rev
        if self.age_cycles == self._age_at_end:  # by the drive's clock, between cycles
            self.age_cycles = self._age_at_end = -1
            return False
        is_first = self.age_cycles > 0
        self.age_cycles = 0
        self._age_at_end = NEVER
        return is_first

    def _home(self, position_rev: float) -> float:
        """Return the joint angle at position 0 that puts the start within +-pi."""
        offset_rad = self._settings.offset_rad
        start_rad = position_rev * self._rad_per_rev + offset_rad
        return offset_rad - round(start_rad / math.tau) * math.tau

    def _on_torques(self, frame: bytes) -> bool:
        values = codec.parse_f32_pair(unpack_frame(frame)[1])
        if values is not None and math.isfinite(values[1]):
            self.tau_meas_Nm = values[1] * self._joint_per_motor
        return False

    def _on_value(self, frame: bytes) -> bool:
        """Take a parameter that was read back. Before the reads are sent, writes are confirmed."""
        answer = codec.parse_sdo(unpack_frame(frame)[1])
        if answer is None or len(self._queue) >= len(self._checks):
            return False
        wanted = self._unverified.get(answer.endpoint)
        if wanted is None:
            return False
        if answer.value[: len(wanted)] == wanted:
            del self._unverified[answer.endpoint]
        else:
            self.note = f"{self.label}: its watchdog does not read back as it was written"
        return False

    def _on_errors(self, frame: bytes) -> bool:
        errors = codec.parse_u32_pair(unpack_frame(frame)[1])
        if errors is not None and errors[1] and self.status is not AxisStatus.ENABLED:
            names = codec.describe_errors(errors[1])
            self.note = f"{self.label}: disarmed by {names}"
        return False

    def _on_heartbeat(self, frame: bytes) -> bool:
        beat = codec.parse_heartbeat(unpack_frame(frame)[1])
        if beat is None:
            return False
        self._heartbeat_age = 0
        self._is_clean = not (beat.errors or self._unsettled_cycles)
        if beat.errors & AxisError.INITIALIZING:
            self._lose("restarted by itself (INITIALIZING)")
            return False
        if self.status is AxisStatus.LOST:
            self.status = AxisStatus.DISABLED  # the loop has latched the loss by now
        if beat.errors:
            self._take_errors(beat.errors)
        elif beat.state == AxisState.CLOSED_LOOP_CONTROL:
            self._take_power()
        else:
            self._take_rest(beat)
        return False

    def _take_errors(self, errors: int) -> None:
        if self._forgiven_cycles:
            return
        is_silence = errors == AxisError.WATCHDOG_TIMER_EXPIRED and self._request_age < 0
        if is_silence and self.status is AxisStatus.DISABLED:  # not commanded yet: no fault
            if self._clear not in self._queue:
                self._queue.appendleft(self._clear)
            return
        if self.status is not AxisStatus.FAULT:
            self._drop_power()
            self.status = AxisStatus.FAULT
            self.note = f"{self.label}: {codec.describe_errors(errors)} (error {errors:08X})"

    def _take_power(self) -> None:
        if self._wants_power:
            if self._request_age >= SETTLED_CYCLES:
                self.status = AxisStatus.ENABLED
        elif not self._queue:
            self._queue.append(self._idle)  # the request was lost, or somebody else enables it

    def _take_rest(self, beat: Heartbeat) -> None:
        if self.status is AxisStatus.ENABLED:  # power went off: only `enable` may ask again
            self._drop_power()
            self._queue.append(self._ask_errors)
            state = codec.describe_state(beat.state)
            self.note = f"{self.label}: left closed loop control by itself, now {state}"
        elif self._request_age >= SETTLED_CYCLES and beat.state == AxisState.IDLE:
            result = codec.describe_result(beat.result)
            self.note = f"{self.label}: does not enter closed loop control: {result}"
        self.status = AxisStatus.DISABLED


def _clip(tau_Nm: float, limit_Nm: float) -> float:
    """Limit to +-`limit_Nm`; NaN becomes 0."""
    return math.copysign(limit_Nm, tau_Nm) if abs(tau_Nm) > limit_Nm else 0.0
