"""The emulated ODrive on the wire: CANSimple of firmware 0.6, one axis."""

from collections.abc import Callable

from pydantic import BaseModel, ConfigDict, Field

from drivers.frame import RTR_FLAG, pack_frame
from drivers.odrive import codec
from drivers.odrive.codec import BROADCAST_NODE, Address, AxisError, Command, Sdo, Version
from drivers.odrive.endpoints import EMULATED, Endpoint, EndpointTable, emulated_serial
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.odrive.axis import OdriveAxisModel
from sim_backend.odrive.parameters import Parameters
from sim_backend.servo import Servo

PROTOCOL = 2
REBOOT, SAVE, ERASE = 0, 1, 2
_AMBIENT = 25.0
_PHASES_MS = {Endpoint.HEARTBEAT_RATE: 0, Endpoint.TORQUES_RATE: 5, Endpoint.ENCODER_RATE: 0}
_NODE_PHASE_MS = 13
"""Drives are not switched on in the same millisecond: their cyclic messages are spread."""
_BROADCASTS = frozenset((Command.ESTOP, Command.ADDRESS, Command.REBOOT, Command.CLEAR_ERRORS))


class OdriveNodeSettings(BaseModel):
    """What can be set of an emulated ODrive."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    gear_ratio: float = Field(1.0, gt=0, description="motor turns per joint turn")
    serial: int | None = Field(
        None, ge=0, lt=1 << 48, description="default: one that tells it is emulated"
    )
    is_calibrated: bool = Field(True, description="it may enter closed loop control at once")


class OdriveNode(AmplifierNode):
    """One ODrive axis.

    Position and velocity are the motor's, in turns. Any frame for the node feeds its watchdog.

    Args:
        node_id: 0 to 62, or 63: it has none yet and answers 0x06 only.
        servo: The axis behind it.
        transmit: Puts a frame record on the wire.
        settings: See `OdriveNodeSettings`.
        table: Firmware, board and endpoint numbers it claims.
        is_lockstep: What it tells the master: plant time follows the lockstep frame.

    Attributes:
        node_id: As assigned by the last 0x06.
        axis: States, errors, torque.
        parameters: What 0x04 reads and writes.
    """

    takes_remote_requests = True

    def __init__(
        self,
        node_id: int,
        servo: Servo,
        transmit: Transmit,
        settings: OdriveNodeSettings | None = None,
        *,
        table: EndpointTable = EMULATED,
        is_lockstep: bool = False,
    ) -> None:
        super().__init__(servo, transmit)
        settings = settings or OdriveNodeSettings()
        self.node_id = node_id
        self.serial = emulated_serial(node_id) if settings.serial is None else settings.serial
        self.axis = OdriveAxisModel(
            servo, settings.gear_ratio, is_calibrated=settings.is_calibrated
        )
        self.parameters = Parameters(
            self.axis,
            table,
            is_lockstep=is_lockstep,
            on_fault=lambda: self.axis.fail(AxisError.DRV_FAULT),
        )
        self._version = Version(PROTOCOL, table.hardware, table.firmware, is_unreleased=False)
        self._is_on = False
        self._clock_ms = 0
        self._readers = self._make_readers()
        self._writers = self._make_writers()

    # --- AmplifierNode ------------------------------------------------------------------------

    def power_on(self) -> None:
        """Start as after power-up: saved parameters, address told, first heartbeat."""
        self._is_on = True
        self.axis.power_on()
        self.parameters.restore()
        self._clock_ms = 0
        self._tell(Command.ADDRESS)
        self._send_heartbeat()

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`."""
        node = (can_id & ~RTR_FLAG) >> codec.NODE_BITS  # an extended one is no node's
        if not self._is_on or (node != self.node_id and node != BROADCAST_NODE):  # noqa: PLR1714
            return
        number = can_id & 0x1F
        if node != BROADCAST_NODE:
            self.axis.feed_watchdog()
        elif number not in _BROADCASTS:
            return
        if (not data or can_id & RTR_FLAG) and number in self._readers:
            self._tell(number)
        elif number in self._writers:
            self._writers[number](data)

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`."""
        if not self._is_on:
            return
        self.axis.tick(dt_s)
        self._clock_ms += 1
        if self._is_due(Endpoint.HEARTBEAT_RATE):
            self._send_heartbeat()
        if self._is_due(Endpoint.TORQUES_RATE):
            self._tell(Command.TORQUES)

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`: disarmed, DRV_FAULT."""
        self.axis.fail(AxisError.DRV_FAULT)

    def begin_period(self) -> None:
        """Send the encoder estimates when they are due."""
        if self._is_on and self._is_due(Endpoint.ENCODER_RATE):
            self._tell(Command.ENCODER)

    # --- what is asked for ----------------------------------------------------------------------

    def _make_readers(self) -> dict[int, Callable[[], bytes]]:
        axis, servo = self.axis, self.servo
        pair = codec.F32_PAIR.pack
        constant = axis.torque_constant_Nm_A
        supply_V = servo.settings.supply_V
        return {
            Command.VERSION: lambda: codec.pack_version(self._version),
            Command.ERROR: lambda: codec.U32_PAIR.pack(axis.errors, axis.disarm_reason),
            Command.ADDRESS: lambda: codec.pack_address(Address(self.node_id, self.serial)),
            Command.ENCODER: self._estimates,
            Command.IQ: lambda: pair(axis.torque_target_Nm / constant, servo.current_A),
            Command.TEMPERATURE: lambda: pair(_AMBIENT, _AMBIENT),
            Command.BUS: lambda: pair(supply_V, self._electrical_W() / supply_V),
            Command.TORQUES: lambda: pair(axis.torque_target_Nm, axis.torque_estimate_Nm),
            Command.POWERS: lambda: pair(self._electrical_W(), self._mechanical_W()),
        }

    def _estimates(self) -> bytes:
        encoder = self.axis.encoder
        return codec.pack_f32(encoder.position_rev()) + codec.pack_f32(encoder.velocity_rev_s)

    def _mechanical_W(self) -> float:
        return self.servo.torque_Nm * self.servo.motor_rad_s

    def _electrical_W(self) -> float:
        servo = self.servo
        return self._mechanical_W() + servo.settings.resistance_ohm * servo.current_A**2

    # --- what is set ----------------------------------------------------------------------------

    def _make_writers(self) -> dict[int, Callable[[bytes], None]]:
        return {
            Command.ESTOP: lambda _: self.axis.fail(AxisError.ESTOP_REQUESTED),
            Command.RX_SDO: self._on_sdo,
            Command.ADDRESS: self._on_address,
            Command.AXIS_STATE: self._on_axis_state,
            Command.CONTROLLER_MODE: self._on_mode,
            Command.INPUT_POS: self._on_input_pos,
            Command.INPUT_VEL: self._on_input_vel,
            Command.INPUT_TORQUE: self._on_input_torque,
            Command.LIMITS: self._on_limits,
            Command.REBOOT: self._on_reboot,
            Command.CLEAR_ERRORS: lambda _: self.axis.clear_errors(),
            Command.ABSOLUTE_POSITION: self._on_absolute_position,
            Command.POS_GAIN: self._on_pos_gain,
            Command.VEL_GAINS: self._on_vel_gains,
        }

    def _on_input_torque(self, data: bytes) -> None:
        torque_Nm = codec.parse_f32(data)
        if torque_Nm is not None:
            self.axis.controller.input_torque_Nm = torque_Nm
            self.axis.apply_input(0.0)

    def _on_input_vel(self, data: bytes) -> None:
        values = codec.parse_f32_pair(data)
        if values is not None:
            controller = self.axis.controller
            controller.input_vel_rev_s, controller.input_torque_Nm = values

    def _on_input_pos(self, data: bytes) -> None:
        position_rev = codec.parse_f32(data)
        if position_rev is not None:
            self.axis.controller.input_pos_rev = position_rev

    def _on_mode(self, data: bytes) -> None:
        modes = codec.parse_u32_pair(data)
        if modes is not None:
            self.axis.controller.mode, self.axis.controller.input_mode = modes

    def _on_axis_state(self, data: bytes) -> None:
        state = codec.parse_u32(data)
        if state is not None:
            self.axis.request(state)

    def _on_limits(self, data: bytes) -> None:
        limits = codec.parse_f32_pair(data)
        if limits is not None:
            self.axis.controller.vel_limit_rev_s, self.axis.current_soft_max_A = limits

    def _on_pos_gain(self, data: bytes) -> None:
        gain = codec.parse_f32(data)
        if gain is not None:
            self.axis.controller.pos_gain = gain

    def _on_vel_gains(self, data: bytes) -> None:
        gains = codec.parse_f32_pair(data)
        if gains is not None:
            controller = self.axis.controller
            controller.vel_gain, controller.vel_integrator_gain = gains

    def _on_absolute_position(self, data: bytes) -> None:
        position_rev = codec.parse_f32(data)
        if position_rev is not None and abs(position_rev) < codec.POSITION_MAX_REV:
            self.axis.encoder.set_position(position_rev)

    def _on_sdo(self, data: bytes) -> None:
        sdo = codec.parse_sdo(data)
        value = None if sdo is None else self.parameters.exchange(sdo)
        if sdo is not None and value is not None:
            self._send(Command.TX_SDO, codec.pack_sdo(Sdo(0, sdo.endpoint, value)))

    def _on_reboot(self, data: bytes) -> None:
        action = data[0] if data else REBOOT
        if action == SAVE:
            self.parameters.save()
            return
        if action == ERASE:
            self.parameters.erase()
        if action in (REBOOT, ERASE):
            self.power_on()

    def _on_address(self, data: bytes) -> None:
        """Take the node id meant for this serial number; leave one that is meant for another."""
        address = codec.parse_address(data)
        if address is None or address.node > BROADCAST_NODE:
            return
        if address.serial == self.serial:
            self.node_id = address.node
        elif address.node == self.node_id:
            self.node_id = BROADCAST_NODE
        else:
            return
        self._tell(Command.ADDRESS)

    # --- out --------------------------------------------------------------------------------------

    def _is_due(self, endpoint: Endpoint) -> bool:
        """Tell whether a cyclic message is due in this millisecond."""
        rate_ms = self.parameters.rates_ms[endpoint]
        if not rate_ms or self.node_id == BROADCAST_NODE:
            return False
        phase_ms = _PHASES_MS[endpoint] + _NODE_PHASE_MS * self.node_id
        return (self._clock_ms + phase_ms) % rate_ms == 0

    def _send_heartbeat(self) -> None:
        self._send(Command.HEARTBEAT, codec.pack_heartbeat(self.axis.heartbeat()))

    def _tell(self, number: int) -> None:
        self._send(number, self._readers[number]())

    def _send(self, number: int, data: bytes) -> None:
        self._transmit(pack_frame(codec.can_id(self.node_id, number), data))
