"""Master side of one MIT-mode motor: what all variants share, and the choice between them."""

import math
from abc import abstractmethod
from importlib import import_module
from typing import Self

from drivers.axis import Axis, AxisInfo, AxisStatus, Port
from drivers.errors import AmplifierError
from drivers.frame import pack_frame
from drivers.mit import codec
from drivers.mit.settings import MitSettings

STOP_FRAMES = 2
"""Frames that end power: no torque, then off."""
RESET_CYCLES = 5
"""Cycles in which a fault is cleared before the answers are believed again."""
LISTEN_S = 0.02
"""How long another master is listened for."""

_AXES = {  # variant -> "module:class"
    "damiao": "drivers.mit.damiao:DamiaoAxis",
    "tmotor": "drivers.mit.mini_cheetah:MiniCheetahAxis",
    "cubemars": "drivers.mit.mini_cheetah:MiniCheetahAxis",
    "cybergear": "drivers.mit.robstride:RobStrideAxis",
    "robstride": "drivers.mit.robstride:RobStrideAxis",
}


class MitAxis(Axis):
    """One motor that answers every frame with its state.

    A cycle begins with the torque computed in the cycle before; the answer is the feedback of
    that instant. Without power, frames that cannot move the motor are answered likewise.

    A motor may remember its last set-point and follow it the moment it is enabled. Therefore the
    last frame before power goes off asks for no torque, and so does the one before power goes on;
    and what enables is sent at the end of a cycle, shortly before the next set-point.

    Built as `MitAxis`, it is the class of its settings' variant.
    """

    def __new__(cls, settings: MitSettings, *, joint: int, period_s: float) -> Self:
        """Choose the variant's class."""
        del joint, period_s
        module, _, name = _AXES[settings.variant].partition(":")
        chosen = getattr(import_module(module), name) if cls is MitAxis else cls
        made: Self = object.__new__(chosen)
        return made

    def __init__(self, settings: MitSettings, *, joint: int, period_s: float) -> None:
        super().__init__(f"joint {joint} ({settings.variant} {settings.node_id})")
        self._settings = settings
        self._is_emulated = False
        direction, codes = settings.direction, settings.torque_codes
        # code = top - int(shift - tau * scale), the nearest one, towards zero in the middle
        scale = codes / (2.0 * settings.torque_range_Nm)
        self._torque_scale = direction * scale
        self._torque_shift = codes / 2.0 + 0.5
        self._torque_top = codes
        self._torque_low, self._torque_high = codec.torque_codes_within(
            settings.torque_max_Nm, settings.torque_range_Nm, codes
        )
        self._torque_step_Nm = direction * settings.torque_resolution_Nm
        self._torque_zero_Nm = -direction * settings.torque_range_Nm
        self._angle_step_rad = direction * settings.angle_resolution_rad
        self._angle_zero_rad = settings.offset_rad - direction * settings.position_range_rad
        self._rate_step_rad_s = direction * 2.0 * settings.velocity_range_rad_s / codes
        self._rate_zero_rad_s = -direction * settings.velocity_range_rad_s
        self._is_turn_known = False
        self._wants_power = False
        self._stop_frames = 0
        self._reset_cycles = 0
        self._silence = 0
        self._silence_limit = math.ceil(1e-3 * settings.silence_ms / period_s)
        self._status_code = -1
        self._build_frames()
        self._torque_frame = self._zero_frame

    _zero_frame: bytes
    """Set-point of (nearly) no torque."""
    _stop_frame: bytes
    _poll_frame: bytes
    """Asks a motor without power for its state, and changes nothing."""
    _enable_frame: bytes
    _clear_frame: bytes

    @abstractmethod
    def _build_frames(self) -> None:
        """Set the frames above."""

    @abstractmethod
    def _torque_frame_of(self, code: int) -> bytes:
        """Return the set-point with this torque code and nothing else."""

    # --- start-up ---------------------------------------------------------------------------

    def start(self, port: Port) -> None:
        """See `Axis.start`: nothing to do, the first cycle's request begins it."""

    def _info(self, name: str, *, is_lockstep: bool) -> AxisInfo:
        s = self._settings
        steps = s.torque_resolution_Nm, s.angle_resolution_rad
        return AxisInfo(name, *steps, is_lockstep, self._is_emulated)

    def _ask(self, port: Port, can_id: int, data: bytes, reply_id: int) -> bytes:
        """Send a frame and return the data of the answer.

        Raises:
            AmplifierError: If there is none in time.
        """
        port.send(can_id, data)
        reply = port.wait(reply_id, self._settings.reply_timeout_s)
        if reply is None:
            raise self._silent(reply_id)
        return reply

    def _silent(self, reply_id: int) -> AmplifierError:
        return AmplifierError(
            f"{self.label}: no answer on identifier 0x{reply_id & 0x1FFF_FFFF:X} within "
            f"{self._settings.reply_timeout_s:g} s; check its power, node_id and master_id"
        )

    def _already_enabled(self) -> AmplifierError:
        return AmplifierError(
            f"{self.label}: is already enabled, perhaps by another master; disable it before "
            "starting"
        )

    def _require(self, what: str, found: float, wanted: float, setting: str) -> None:
        if not math.isclose(found, wanted, rel_tol=1e-5):
            raise AmplifierError(
                f"{self.label}: {what} is {found:g}, the configuration says {wanted:g}; "
                f"correct {setting}"
            )

    # --- in operation -----------------------------------------------------------------------

    def request(self) -> bytes:
        """The torque of the last `command`; without power, what reads the state."""
        if self.status is AxisStatus.ENABLED and self._wants_power:
            return self._torque_frame
        if self._stop_frames:
            return self._next_stop()
        if self._reset_cycles:
            self._reset_cycles -= 1
            return self._clear_frame
        if self.status is AxisStatus.DISABLED:
            return self._zero_frame if self._wants_power else self._poll_frame
        return self._poll_frame if self.status is AxisStatus.FAULT else self._stop_frame

    def command(self, tau_Nm: float) -> bytes | None:
        """Keep the torque for the next `request`; what ends power goes out at once."""
        if self.status is AxisStatus.ENABLED and self._wants_power:
            exact = self._torque_shift - tau_Nm * self._torque_scale
            top = self._torque_top
            if 0.0 <= exact <= top:
                code = top - int(exact)
            elif exact < 0.0:
                code = top
            else:
                code = 0 if exact > top else top // 2
            if code > self._torque_high:
                code = self._torque_high
            elif code < self._torque_low:
                code = self._torque_low
            self._torque_frame = self._torque_frame_of(code)
            return None
        self._torque_frame = self._zero_frame
        if self._stop_frames:
            return self._next_stop()
        if self._wants_power and self.status is AxisStatus.DISABLED and not self._reset_cycles:
            return self._enable_frame
        return None

    def _next_stop(self) -> bytes:
        self._stop_frames -= 1
        return self._zero_frame if self._stop_frames else self._stop_frame

    def enable(self) -> None:
        """Ask for power, with the next `command`."""
        self._wants_power = True
        self._stop_frames = 0
        self._torque_frame = self._zero_frame

    def disable(self) -> None:
        """Ask for torque off with the next frame, and power off with the one after it."""
        if self._wants_power or self.status is AxisStatus.ENABLED:
            self._stop_frames = STOP_FRAMES
        self._wants_power = False

    def reset_fault(self) -> None:
        """Clear the fault in the next cycles; also forgives silence."""
        self.disable()
        self.note = ""
        self.status = AxisStatus.DISABLED
        self._silence = 0
        self._status_code = -1
        self._reset_cycles = RESET_CYCLES

    def end_cycle(self) -> None:
        """Count the silence since the last answer."""
        self._silence += 1
        if self._silence > self._silence_limit and self.status is not AxisStatus.LOST:
            self._wants_power = False
            self._stop_frames = STOP_FRAMES
            self.status = AxisStatus.LOST
            self.note = f"{self.label}: no answer for {self._silence} cycles"

    def inject_fault(self) -> bytes | None:
        """The frame that only emulated motors know."""
        if not self._is_emulated:
            return None
        can_id = codec.INJECT_FAULT_ID | self._settings.node_id
        return pack_frame(can_id, codec.INJECT_FAULT_DATA)

    def _take_motion(self, position: int, velocity: int, torque: int) -> bool:
        """Take a reply's numbers; True if they are this cycle's first.

        An angle at the end of its range may be any beyond it, and is no feedback.
        """
        self._silence = 0
        if not 0 < position < codec.POSITION_CODES:
            return False
        if not self._is_turn_known:
            self._find_turn(position)
        self.q_rad = position * self._angle_step_rad + self._angle_zero_rad
        self.dq_rad_s = velocity * self._rate_step_rad_s + self._rate_zero_rad_s
        self.tau_meas_Nm = torque * self._torque_step_Nm + self._torque_zero_Nm
        is_first = self.age_cycles > 0
        self.age_cycles = 0
        return is_first

    def _find_turn(self, position: int) -> None:
        """Have the joint's angle start within half a turn, whatever the motor has counted."""
        start_rad = position * self._angle_step_rad + self._angle_zero_rad
        self._angle_zero_rad -= math.tau * round(start_rad / math.tau)
        self._is_turn_known = True

    def _take_power(self, *, is_on: bool) -> None:
        """The motor has no fault, and says whether it is enabled."""
        if is_on:
            self.status = AxisStatus.ENABLED
            return
        if self.status is AxisStatus.ENABLED:  # power went off: only `enable` may ask again
            self._wants_power = False
        self.status = AxisStatus.DISABLED

    def _take_fault(self, name: str) -> None:
        if self._reset_cycles:  # the reset is on its way: judge the next answer
            self._status_code = -1
            return
        self.status = AxisStatus.FAULT
        self._wants_power = False
        self._torque_frame = self._zero_frame
        self.note = f"{self.label}: {name}"
