"""Master side of one moteus controller: torque in, state back, in one exchange a cycle."""

import math
from struct import Struct

from drivers.axis import Axis, AxisInfo, AxisStatus, FrameHandler, Port
from drivers.errors import AmplifierError
from drivers.frame import EFF_FLAG, FD_FRAME_SIZE, pack_fd_frame, unpack_frame
from drivers.moteus import codec
from drivers.moteus.codec import READ, WRITE
from drivers.moteus.console import Console
from drivers.moteus.registers import FAULTS, Mode, Register, Resolution
from drivers.moteus.settings import MoteusSettings

HIL_MODEL_NUMBER = 0x48494C31
"""Register 0x100 of the emulated controller ("HIL1"); only there says 0x121 the time base."""
QUERY_ATTEMPTS = 3
RESET_CYCLES = 10
"""Cycles after a reset in which a fault still reported is not a new one."""
LOSS_CYCLES = 3
"""Cycles for which a loss shows after the replies are back."""
JUMP_REV = 0.25
"""No shaft turns as far as this in a cycle: the controller has started anew."""
TORQUE_CONSTANT_KV_Nm_A = 8.27
"""Torque constant times Kv [rpm/V]: 60 / (2 pi) * sqrt(3) / 2."""
TORQUE_TOLERANCE = 1.25
"""Firmware versions differ in what they call Kv: only a gross error of scale is refused."""
_TIMEOUT_MODES = {"stop": Mode.STOPPED, "brake": Mode.BRAKE, "damp": Mode.ZERO_VELOCITY}
UNKNOWN = -1
"""No mode: the next reply's is looked at afresh."""
_FLOAT = Struct("<f")
_STATE = codec.STATE.unpack_from
_AT_REST = frozenset((Mode.STOPPED, Mode.FAULT))
_ON_THE_WAY = frozenset((Mode.ENABLING, Mode.CALIBRATING, Mode.CALIBRATION_COMPLETE))


class MoteusAxis(Axis):
    """One moteus controller in mode 10 with all gains scaled to 0.

    Each cycle begins with a request that carries the torque of the cycle before, or only asks for
    the state while the axis is disabled. A stop goes out at the end of the cycle that wants it.
    """

    def __init__(self, settings: MoteusSettings, *, joint: int, period_s: float) -> None:
        super().__init__(f"joint {joint} (moteus id {settings.node_id})")
        s = self._settings = settings
        self._request_id = codec.request_id(s.node_id, s.source_id, prefix=s.can_prefix)
        self._reply_id = codec.reply_id(s.node_id, s.source_id, prefix=s.can_prefix)
        before, after = codec.torque_frame_parts(s.torque_max_Nm, s.watchdog_ms * 1e-3)
        frame = pack_fd_frame(self._request_id, before + bytes(4) + after)
        cut = 8 + len(before)
        self._torque_head, self._torque_tail = frame[:cut], frame[cut + 4 :]
        self._poll = pack_fd_frame(self._request_id, codec.POLL)
        self._stop = pack_fd_frame(self._request_id, codec.STOP)
        self._direction = s.direction
        self._offset_rad = s.offset_rad
        self._rad_per_rev = s.direction * math.tau
        self._torque_max_Nm = s.torque_max_Nm
        self._lost_limit = max(1, math.ceil(s.lost_after_ms * 1e-3 / period_s))
        self._silence = 0
        self._torque_Nm = 0.0
        self._wants_power = False
        self._wants_stop = False
        self._reset_cycles = 0
        self._loss_cycles = 0
        self._fault = 0
        self._mode = UNKNOWN
        self._position_rev = math.nan
        self._turns_rev = 0.0

    # --- start-up ---------------------------------------------------------------------------

    def configure(self, port: Port) -> AxisInfo:
        """Identify the controller, set its watchdog, check its scales; see `Axis.configure`."""
        s = self._settings
        self._refuse_if_enabled(port)
        identity = self._query(
            port,
            codec.pack_head(READ, Register.MODEL_NUMBER, Resolution.INT32, 3)
            + codec.pack_head(READ, Register.SERIAL_NUMBER_1, Resolution.INT32, 3),
        )
        model = int(identity.get(Register.MODEL_NUMBER, -1))
        is_emulated = model == HIL_MODEL_NUMBER
        is_lockstep = is_emulated and identity.get(Register.SERIAL_NUMBER_2) == 1
        self._check_watchdog(port)
        console = Console(port, (self._request_id, self._reply_id), self.label, s.reply_timeout_s)
        console.start()
        console.set("servo.timeout_mode", _TIMEOUT_MODES[s.on_timeout])
        console.set("servo.default_timeout_s", s.watchdog_ms * 1e-3)
        angle_rad = self._check_scales(console)
        version = int(identity.get(Register.FIRMWARE_VERSION, 0))
        name = f"moteus model {model & 0xFFFFFFFF:X} firmware {version & 0xFFFFFFFF:06X}"
        torque_Nm = math.ldexp(1.0, math.frexp(s.torque_max_Nm)[1] - 24)  # float32
        return AxisInfo(name, torque_Nm, angle_rad, is_lockstep, is_emulated)

    def start(self, port: Port) -> None:
        """Nothing to do: the controller is ready for commands."""

    def _query(self, port: Port, data: bytes) -> dict[int, float]:
        for _ in range(QUERY_ATTEMPTS):
            port.send(self._request_id, codec.pad(data), is_fd=True)
            reply = port.wait(self._reply_id, self._settings.reply_timeout_s)
            if reply is not None:
                return codec.parse_replies(reply)
        raise AmplifierError(
            f"{self.label}: does not answer; check power, id.id, can.prefix and the bit rates "
            "(1 and 5 Mbit/s)"
        )

    def _refuse_if_enabled(self, port: Port) -> None:
        mode = int(self._query(port, codec.POLL).get(Register.MODE, -1))
        if mode == Mode.TIMEOUT:  # left behind by a master that died
            self._query(port, codec.STOP)
            mode = int(self._query(port, codec.POLL).get(Register.MODE, -1))
        if mode not in _AT_REST:
            raise AmplifierError(
                f"{self.label}: is already enabled (mode {mode}), perhaps by another master; "
                "stop it before starting"
            )

    def _check_watchdog(self, port: Port) -> None:
        """Write the registers of a command without its mode, which makes it none, and read them."""
        timeout_ms = self._settings.watchdog_ms
        found = self._query(
            port,
            codec.pack_values(WRITE, Register.COMMAND_TIMEOUT, Resolution.INT16, timeout_ms)
            + codec.pack_head(READ, Register.COMMAND_TIMEOUT, Resolution.INT16, 1)
            + codec.pack_head(READ, Register.COMMAND_ILIMIT_SCALE, Resolution.INT8, 1),
        )
        if Register.COMMAND_ILIMIT_SCALE not in found:
            raise AmplifierError(
                f"{self.label}: knows no register 0x02B (integral limit); update its firmware"
            )
        kept_s = found.get(Register.COMMAND_TIMEOUT, math.nan)
        if not abs(kept_s - timeout_ms * 1e-3) < 0.5e-3:
            raise AmplifierError(
                f"{self.label}: command watchdog 0x027 is {1e3 * kept_s:g} ms although "
                f"{timeout_ms} ms were written; correct watchdog_ms"
            )

    def _check_scales(self, console: Console) -> float:
        """Compare encoder and torque with the configuration; return the angle of one count."""
        s = self._settings
        counts = console.get("motor_position.sources.0.cpr")
        if s.counts_per_turn is not None and counts != s.counts_per_turn:
            raise AmplifierError(
                f"{self.label}: motor_position.sources.0.cpr is {counts:g}, the configuration says "
                f"{s.counts_per_turn}; correct counts_per_turn"
            )
        ratio = abs(console.get("motor_position.rotor_to_output_ratio"))
        Kv, current_A = console.get("motor.Kv"), console.get("servo.max_current_A")
        most_Nm = TORQUE_CONSTANT_KV_Nm_A / Kv * current_A / ratio if Kv and ratio else 0.0
        if s.torque_max_Nm > TORQUE_TOLERANCE * most_Nm:
            raise AmplifierError(
                f"{self.label}: torque_max_Nm {s.torque_max_Nm:g} is more than the motor gives, "
                f"{most_Nm:.3g} Nm (motor.Kv {Kv:g}, servo.max_current_A {current_A:g}, "
                f"rotor_to_output_ratio {ratio:g}); correct one of them"
            )
        return math.tau * ratio / max(counts, 1.0)

    # --- in operation -----------------------------------------------------------------------

    def handlers(self) -> dict[int, FrameHandler]:
        """The controller's reply; one that fits 11 bits may come with 29."""
        return {self._reply_id: self._on_reply, self._reply_id | EFF_FLAG: self._on_reply}

    def request(self) -> bytes:
        """Torque of the last `command` while enabled or on the way there, else a bare query."""
        if self._wants_power:
            return self._torque_head + _FLOAT.pack(self._torque_Nm) + self._torque_tail
        return self._poll

    def command(self, tau_Nm: float) -> bytes | None:
        """Keep the torque for the next request; send a stop that is wanted."""
        if not self._wants_power:
            return self._stop if self._wants_stop else None
        if self.status is AxisStatus.ENABLED:
            limit_Nm = self._torque_max_Nm
            if -limit_Nm <= tau_Nm <= limit_Nm:
                self._torque_Nm = tau_Nm * self._direction
            else:
                self._torque_Nm = self._clip(tau_Nm) * self._direction
        return None

    def _clip(self, tau_Nm: float) -> float:
        """Limit a torque that is too large; what is no number is none."""
        if tau_Nm > 0.0:
            return self._torque_max_Nm
        return -self._torque_max_Nm if tau_Nm < 0.0 else 0.0

    def enable(self) -> None:
        """Ask for power: torque commands, of torque 0 until the controller is in mode 10."""
        if self.status in (AxisStatus.DISABLED, AxisStatus.ENABLED):
            self._torque_Nm = 0.0
            self._wants_power = True
            self._wants_stop = False

    def disable(self) -> None:
        """Ask for torque off: stop commands, until the controller reports that it has stopped."""
        if self._wants_power or self._mode not in _AT_REST:
            self._wants_stop = True
            self._mode = UNKNOWN
        self._wants_power = False
        self._torque_Nm = 0.0

    def reset_fault(self) -> None:
        """Send the stop that clears faults and ends mode 11; also forgives silence."""
        self._wants_power = False
        self._torque_Nm = 0.0
        self._wants_stop = True
        self._reset_cycles = RESET_CYCLES
        self._silence = 0
        self.note = ""
        self.status = AxisStatus.DISABLED
        self._mode = UNKNOWN

    def end_cycle(self) -> None:
        """Count the silence since the last reply, and the cycles of a loss or a reset."""
        self._silence += 1
        if self._reset_cycles:
            self._reset_cycles -= 1
        if self.status is AxisStatus.LOST:
            self._end_loss()
        elif self._silence > self._lost_limit:
            self._lose(f"no reply for {self._silence} cycles")

    def inject_fault(self) -> bytes:
        """Write of a register that only the emulated controller has; a real one refuses it."""
        write = codec.pack_values(WRITE, Register.INJECT_FAULT, Resolution.INT8, 33)
        return pack_fd_frame(self._request_id, codec.pad(write))

    def _on_reply(self, frame: bytes) -> bool:
        if frame[4] != codec.STATE_LENGTH or len(frame) != FD_FRAME_SIZE:
            return self._take_unusual(frame)
        head, mode, body, position, velocity, torque, tail, fault = _STATE(frame, 8)
        if head != codec.STATE_HEAD or body != codec.STATE_BODY:
            return self._take_unusual(frame)
        if not self._take_motion(position, velocity, torque):
            return False
        if mode != self._mode:
            self._take_mode(mode)
        if mode == Mode.FAULT and tail == codec.STATE_TAIL:
            self._name_fault(fault)
        is_first = self.age_cycles > 0
        self.age_cycles = 0
        return is_first

    def _take_unusual(self, frame: bytes) -> bool:
        """Take a reply laid out otherwise, for example one with an error in front."""
        values = codec.parse_replies(unpack_frame(frame)[1])
        wanted = (Register.MODE, Register.POSITION, Register.VELOCITY, Register.TORQUE)
        if not all(register in values for register in wanted):
            return False
        mode, position, velocity, torque = (values[register] for register in wanted)
        if not math.isfinite(mode) or not self._take_motion(position, velocity, torque):
            return False
        if int(mode) != self._mode:
            self._take_mode(int(mode))
        is_first = self.age_cycles > 0
        self.age_cycles = 0
        return is_first

    def _take_motion(self, position: float, velocity: float, torque: float) -> bool:
        """Take position [rev], velocity [rev/s] and torque [Nm]; False if one is not finite."""
        if (position + velocity + torque) * 0.0 != 0.0:
            return False
        self._silence = 0
        step = position - self._position_rev
        cycles = self.age_cycles or 1
        if not -JUMP_REV * cycles < step < JUMP_REV * cycles:
            self._begin_turn(position, step)
        self._position_rev = position
        self.q_rad = (position - self._turns_rev) * self._rad_per_rev + self._offset_rad
        self.dq_rad_s = velocity * self._rad_per_rev
        self.tau_meas_Nm = torque * self._direction
        return True

    def _begin_turn(self, position: float, step: float) -> None:
        """Choose the turn that puts the joint within +-pi: at the start, and after a restart."""
        self._turns_rev = float(round(position + self._offset_rad / self._rad_per_rev))
        if step == step:  # NaN at the first feedback  # noqa: PLR0124
            self._lose(f"the position jumped by {step:.3g} rev: restarted by itself?")

    def _take_mode(self, mode: int) -> None:
        self._mode = mode
        if self.status in (AxisStatus.LOST, AxisStatus.FAULT):
            self._wants_stop = mode not in _AT_REST and mode != Mode.TIMEOUT
        elif mode == Mode.POSITION:
            self.status = AxisStatus.ENABLED
            self._wants_stop = not self._wants_power
        elif mode == Mode.STOPPED or mode in _ON_THE_WAY:
            if self.status is AxisStatus.ENABLED:  # power went off: only `enable` may ask again
                self._wants_power = False
            self.status = AxisStatus.DISABLED
            self._wants_stop = mode != Mode.STOPPED and not self._wants_power
        elif self._reset_cycles:  # the reset is on its way: judge the next reply
            self._mode = UNKNOWN
        else:
            self._take_fault(mode)

    def _take_fault(self, mode: int) -> None:
        self.status = AxisStatus.FAULT
        self._wants_power = False
        self._torque_Nm = 0.0
        self._fault = 0
        self._wants_stop = mode not in (Mode.FAULT, Mode.TIMEOUT)
        if mode == Mode.FAULT:
            told = "fault"
        elif mode == Mode.TIMEOUT:
            told = f"no command for {self._settings.watchdog_ms} ms, its watchdog acted (mode 11)"
        else:
            told = f"is in mode {mode}; does another master command it?"
        self.note = f"{self.label}: {told}"

    def _name_fault(self, code: int) -> None:
        if code != self._fault and self.status is AxisStatus.FAULT:
            self._fault = code
            self.note = f"{self.label}: fault {code} ({FAULTS.get(code, 'unknown')})"

    def _lose(self, why: str) -> None:
        self.status = AxisStatus.LOST
        self.note = f"{self.label}: {why}"
        self._wants_power = False
        self._torque_Nm = 0.0
        self._wants_stop = True
        self._mode = UNKNOWN
        self._loss_cycles = LOSS_CYCLES

    def _end_loss(self) -> None:
        """Forget a loss some cycles after the replies are back: the loop has latched it by now."""
        if self._silence > 1:
            return
        self._loss_cycles -= 1
        if self._loss_cycles <= 0:
            self.status = AxisStatus.DISABLED
            self._mode = UNKNOWN
