"""Master side of the mini-cheetah descendants: T-Motor (6-byte replies), CubeMars (8 bytes).

These motors tell neither their ranges nor whether they are enabled, cannot be asked about their
command watchdog, and remember their last set-point while disabled.
"""

from drivers.axis import AxisInfo, AxisStatus, FrameHandler, Port
from drivers.errors import AmplifierError
from drivers.frame import pack_frame
from drivers.mit import codec
from drivers.mit.master import LISTEN_S, MitAxis

ANSWERS_TO_ENABLE = 4
"""Replies while enabling that count as enabled: the first ones may belong to earlier frames."""
_ERROR_INDEX = 15
"""Of CubeMars' error in the 16-byte record."""


class MiniCheetahAxis(MitAxis):
    """One motor of the mini-cheetah kind; a fault is kept in mind until it is reset."""

    def _build_frames(self) -> None:
        node = self._settings.node_id
        rest = codec.Codes(codec.ZERO_POSITION, codec.ZERO_SHORT, 0, 0, codec.ZERO_SHORT)
        self._zero_frame = pack_frame(node, codec.pack_codes(rest))
        self._torque_head = self._zero_frame[:14]
        self._stop_frame = self._poll_frame = pack_frame(node, codec.DISABLE)
        self._clear_frame = self._stop_frame
        self._enable_frame = pack_frame(node, codec.ENABLE)
        self._length = (
            codec.SHORT_FEEDBACK_BYTES
            if self._settings.variant == "tmotor"
            else codec.FEEDBACK_BYTES
        )
        self._answers = 0

    def _torque_frame_of(self, code: int) -> bytes:
        return self._torque_head + code.to_bytes(2, "big")  # kd = 0 above the torque's 12 bits

    def configure(self, port: Port) -> AxisInfo:
        """Listen for another master, switch off, and see that the answer fits the variant."""
        s = self._settings
        if port.wait(s.node_id, LISTEN_S) is not None:
            raise AmplifierError(
                f"{self.label}: another master sends to identifier 0x{s.node_id:X}; stop it first"
            )
        data = self._ask(port, s.node_id, codec.DISABLE, s.reply_id)
        feedback = codec.parse_feedback(data)
        if len(data) != self._length or feedback is None or feedback.head != s.node_id:
            raise AmplifierError(
                f"{self.label}: answered {data.hex(' ') or 'nothing'}, expected {self._length} "
                f"bytes that begin with {s.node_id:02x}; correct variant, node_id or master_id"
            )
        self._is_emulated = s.is_lockstep
        name = f"{s.variant} in MIT mode, command watchdog not readable"
        return self._info(name, is_lockstep=s.is_lockstep)

    def handlers(self) -> dict[int, FrameHandler]:
        """The motor's replies; others may share their identifier."""
        return {self._settings.reply_id: self._on_reply}

    def shared_ids(self) -> frozenset[int]:
        """Replies name their motor."""
        return frozenset((self._settings.reply_id,))

    def enable(self) -> None:
        """See `Axis.enable`."""
        super().enable()
        self._answers = 0

    def inject_fault(self) -> bytes | None:
        """T-Motor's replies have no room for a fault: none can be seen, so none is made."""
        return None if self._settings.variant == "tmotor" else super().inject_fault()

    def request(self) -> bytes:
        """See `MitAxis.request`; that the motor is off we take from our own stop frame."""
        if self.status is AxisStatus.ENABLED and not self._wants_power and not self._stop_frames:
            self.status = AxisStatus.DISABLED
        return super().request()

    def _on_reply(self, frame: bytes) -> bool:
        if frame[4] != self._length:
            return False
        head, position, mixed, torque_low = codec.FEEDBACK.unpack_from(frame, 8)
        if head != self._settings.node_id:
            return False
        error = frame[_ERROR_INDEX] if self._length == codec.FEEDBACK_BYTES else 0
        if error != self._status_code or self.status is not AxisStatus.ENABLED:
            self._take_error(error)
        return self._take_motion(position, mixed >> 4, (mixed & 0xF) << 8 | torque_low)

    def _take_error(self, error: int) -> None:
        self._status_code = error
        if error:
            name = codec.CUBEMARS_ERRORS.get(error, "undocumented")
            self._take_fault(f"drive fault {error}, {name}")
        elif self._wants_power and self.status is AxisStatus.DISABLED:
            self._answers += 1
            self._take_power(is_on=self._answers >= ANSWERS_TO_ENABLE)
        elif self.status is AxisStatus.LOST:
            self._take_power(is_on=False)
