"""The emulated CiA 402 drive on the wire: network management, SYNC, watchdogs, start-up."""

from collections.abc import Callable
from functools import partial

from pydantic import BaseModel, ConfigDict, Field

from drivers.cia402.codec import (
    COB_EMCY,
    COB_HEARTBEAT,
    COB_NMT,
    COB_SDO_RX,
    COB_SDO_TX,
    COB_SYNC,
    Cia402State,
    EmcyCode,
    Index,
    NmtCommand,
    NmtState,
    pack_heartbeat,
    parse_nmt,
)
from drivers.cia402.sdo import SdoAbort
from drivers.frame import pack_frame
from sim_backend.cia402.dictionary import COMMUNICATION_AREA, ObjectDictionary, key_of
from sim_backend.cia402.drive import Drive
from sim_backend.cia402.emergency import HISTORY_LENGTH, Emergency
from sim_backend.cia402.heartbeat import HeartbeatConsumer, HeartbeatProducer
from sim_backend.cia402.pdo import Rpdo, Tpdo
from sim_backend.cia402.sdo_server import SdoServer
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.servo import Servo

_WHOLE_DICTIONARY = range(0x1000, 0x10000)
_SYNC_BYTES_MAX = 1  # with or without counter
_FAULT, _DISABLE_VOLTAGE, _QUICK_STOP = 1, 2, 3  # 6007, abort connection option


class Cia402Settings(BaseModel):
    """What can be set of an emulated CiA 402 drive."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    rated_torque_Nm: float | None = Field(
        None, gt=0, description="1000 per mille of 6071 and 6077; default: torque at peak current"
    )
    heartbeat_ms: int = Field(0, ge=0, le=0xFFFF, description="1017 after power-on, 0 = off")
    serial: int = Field(0, ge=0, le=0xFFFF_FFFF, description="1018:04")


class Cia402Node(AmplifierNode):
    """A CANopen drive (CiA 301, CiA 402) with cyclic synchronous torque.

    Attributes:
        node_id: 1 to 127.
        drive: Drive application: state machine, torque, scaling.
        dictionary: Its object dictionary.
        nmt_state: What works: SDO in PRE-OPERATIONAL and OPERATIONAL, PDO in OPERATIONAL only.
    """

    def __init__(
        self,
        node_id: int,
        servo: Servo,
        transmit: Transmit,
        settings: Cia402Settings | None = None,
        *,
        is_lockstep: bool = False,
    ) -> None:
        """Build the drive, silent until `power_on`.

        Args:
            node_id: 1 to 127.
            servo: The axis behind it.
            transmit: Puts a frame record on the wire.
            settings: Ratings and identity; default ratings follow the servo's peak current.
            is_lockstep: What 2F00 tells the master: plant time follows SYNC.
        """
        super().__init__(servo, transmit)
        settings = settings or Cia402Settings()
        self.node_id = node_id
        self.nmt_state = NmtState.INITIALISING
        self._emergency = Emergency(partial(self._send, COB_EMCY + node_id))
        rated_Nm = settings.rated_torque_Nm or servo.torque_max_Nm
        self.drive = Drive(servo, rated_Nm, self._emergency)
        self.dictionary = ObjectDictionary(node_id, self._fixed_values(settings, is_lockstep))
        self._sdo_server = SdoServer(self.dictionary, partial(self._send, COB_SDO_TX + node_id))
        self._rpdos = [
            Rpdo(self.dictionary, index, self._emergency)
            for index in (Index.RPDO1_PARAMETER, Index.RPDO2_PARAMETER)
        ]
        self._tpdos = [
            Tpdo(self.dictionary, index, transmit)
            for index in (Index.TPDO1_PARAMETER, Index.TPDO2_PARAMETER)
        ]
        self._producer = HeartbeatProducer()
        self._consumer = HeartbeatConsumer()
        self._bind()
        self._route()

    def _fixed_values(self, settings: Cia402Settings, is_lockstep: bool) -> dict[int, int]:
        per_turn = self.servo.counts_per_turn
        return {
            key_of(Index.IDENTITY, 4): settings.serial,
            key_of(Index.PRODUCER_HEARTBEAT, 0): settings.heartbeat_ms,
            key_of(Index.TIME_BASE, 0): int(is_lockstep),
            key_of(Index.RATED_CURRENT, 0): self.drive.rated_current_mA,
            key_of(Index.RATED_TORQUE, 0): self.drive.rated_torque_mNm,
            key_of(Index.POSITION_RANGE, 2): per_turn - 1,
            key_of(Index.ENCODER_RESOLUTION, 1): per_turn,
        }

    @property
    def cycle_time_s(self) -> float:
        """Period between SYNCs as the master announced it (60C2)."""
        values = self.dictionary.values
        exponent: int = values[key_of(Index.CYCLE_TIME, 2)]
        return float(values[key_of(Index.CYCLE_TIME, 1)] * 10.0**exponent)

    # --- AmplifierNode ------------------------------------------------------------------------

    def power_on(self) -> None:
        """Start as after power-up: defaults, boot-up message, PRE-OPERATIONAL."""
        self._emergency.forget()
        self.drive.power_on()
        self._boot(_WHOLE_DICTIONARY)

    def receive(self, can_id: int, data: bytes) -> None:
        """See `AmplifierNode.receive`. What the NMT state does not allow has no handler."""
        handler = self._handlers.get(can_id)
        if handler is not None:
            handler(data)

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`: FAULT, EMCY 5001h."""
        self._inject_fault(1)

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`. A deadline is never judged later than it is due."""
        if self.nmt_state is NmtState.INITIALISING:
            return
        self.drive.settle()
        if self._producer.is_due(dt_s):
            self._send(COB_HEARTBEAT + self.node_id, pack_heartbeat(self.nmt_state))
        if self._consumer.is_overdue(dt_s):
            self._lose_connection(EmcyCode.HEARTBEAT_LOST)
        for rpdo in self._watched_rpdos:
            is_enabled = self.drive.machine.state is Cia402State.OPERATION_ENABLED
            if rpdo.is_overdue(dt_s, is_enabled=is_enabled):
                self._lose_connection(EmcyCode.RPDO_TIMEOUT, rpdo)
        for tpdo in self._timed_tpdos:
            tpdo.tick(dt_s)

    # --- communication objects ----------------------------------------------------------------

    def _bind(self) -> None:
        bind, emergency = self.dictionary.bind, self._emergency
        self.drive.bind(self.dictionary)
        bind(Index.ERROR_REGISTER, read=lambda: emergency.error_register)
        bind(Index.ERROR_CODE, read=lambda: emergency.error_code)
        bind(Index.ERROR_HISTORY, read=lambda: len(emergency.history), write=self._clear_history)
        for subindex in range(1, HISTORY_LENGTH + 1):
            bind(Index.ERROR_HISTORY, subindex, read=partial(self._past_error, subindex))
        bind(Index.PRODUCER_HEARTBEAT, write=self._set_producer)
        bind(Index.CONSUMER_HEARTBEAT, 1, write=self._set_consumer)
        bind(Index.INJECT_FAULT, write=self._inject_fault)
        for rpdo in self._rpdos:
            rpdo.on_change = partial(self._recompile, rpdo)
        for tpdo in self._tpdos:
            tpdo.on_change = partial(self._recompile, tpdo)

    def _past_error(self, subindex: int) -> int | None:
        history = self._emergency.history
        return history[subindex - 1] if subindex <= len(history) else None

    def _clear_history(self, count: int) -> SdoAbort | None:
        if count:
            return SdoAbort.VALUE_RANGE
        self._emergency.history.clear()
        return None

    def _set_producer(self, period_ms: int) -> None:
        self.dictionary.values[key_of(Index.PRODUCER_HEARTBEAT, 0)] = period_ms
        self._producer.start(period_ms)

    def _set_consumer(self, setting: int) -> None:
        self.dictionary.values[key_of(Index.CONSUMER_HEARTBEAT, 1)] = setting
        self._consumer.watch(setting)
        self._recover_from(EmcyCode.HEARTBEAT_LOST)
        self._route()

    def _inject_fault(self, number: int) -> None:
        if number:
            self.drive.fail(EmcyCode.HARDWARE + number)

    def _recompile(self, pdo: Rpdo | Tpdo) -> None:
        pdo.compile()
        self._route()

    # --- network management -------------------------------------------------------------------

    def _boot(self, area: range) -> None:
        """Restore an area of the dictionary, announce the node, go to PRE-OPERATIONAL."""
        self.nmt_state = NmtState.INITIALISING
        values = self.dictionary.values
        self.dictionary.restore(area)
        self._sdo_server.reset()
        self._producer.start(values[key_of(Index.PRODUCER_HEARTBEAT, 0)])
        self._consumer.watch(values[key_of(Index.CONSUMER_HEARTBEAT, 1)])
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.compile()
        self._send(COB_HEARTBEAT + self.node_id, pack_heartbeat(NmtState.INITIALISING))
        self._enter(NmtState.PRE_OPERATIONAL)

    def _on_nmt(self, data: bytes) -> None:
        parsed = parse_nmt(data)
        if parsed is None or parsed[1] not in (0, self.node_id):
            return
        command = parsed[0]
        if command is NmtCommand.START:
            self._enter(NmtState.OPERATIONAL)
            return
        self._leave_operational()
        if command is NmtCommand.STOP:
            self._enter(NmtState.STOPPED)
        elif command is NmtCommand.ENTER_PRE_OPERATIONAL:
            self._enter(NmtState.PRE_OPERATIONAL)
        elif command is NmtCommand.RESET_COMMUNICATION:
            self._boot(COMMUNICATION_AREA)
        else:
            self.power_on()

    def _enter(self, state: NmtState) -> None:
        if state is self.nmt_state:
            return
        self.nmt_state = state
        for pdo in (*self._rpdos, *self._tpdos):
            pdo.forget()
        if state is NmtState.STOPPED:
            self._sdo_server.reset()
        if state is NmtState.OPERATIONAL:
            self._recover_from(EmcyCode.COMMUNICATION)
        self._route()

    def _leave_operational(self) -> None:
        """A powered drive loses its commands with OPERATIONAL: the case 6007 is made for."""
        if self.drive.machine.is_powered:
            self._lose_connection(EmcyCode.COMMUNICATION)

    def _route(self) -> None:
        """Rebuild the handlers by identifier that the NMT state allows."""
        state = self.nmt_state
        is_operational = state is NmtState.OPERATIONAL
        rpdos = [rpdo for rpdo in self._rpdos if rpdo.is_on and is_operational]
        self._sync_rpdos = [rpdo for rpdo in rpdos if rpdo.is_synchronous]
        self._watched_rpdos = [rpdo for rpdo in rpdos if rpdo.event_timer_s]
        tpdos = [tpdo for tpdo in self._tpdos if tpdo.is_on and is_operational]
        self._sync_tpdos = [tpdo for tpdo in tpdos if not tpdo.is_event_driven]
        self._timed_tpdos = [tpdo for tpdo in tpdos if tpdo.is_event_driven]
        self._handlers: dict[int, Callable[[bytes], None]] = {}
        if state is NmtState.INITIALISING:
            return
        self._handlers[COB_NMT] = self._on_nmt
        if self._consumer.node_id:
            self._handlers[COB_HEARTBEAT + self._consumer.node_id] = self._on_heartbeat
        if state is not NmtState.STOPPED:
            self._handlers[COB_SDO_RX + self.node_id] = self._sdo_server.receive
        if is_operational:
            self._handlers[COB_SYNC] = self._on_sync
            self._handlers |= {rpdo.can_id: rpdo.receive for rpdo in rpdos}

    def _send(self, can_id: int, data: bytes) -> None:
        if self.nmt_state is NmtState.STOPPED and can_id < COB_HEARTBEAT:
            return  # only NMT and heartbeat live in STOPPED
        self._transmit(pack_frame(can_id, data))

    # --- the cycle ----------------------------------------------------------------------------

    def _on_sync(self, data: bytes) -> None:
        if len(data) > _SYNC_BYTES_MAX:
            return
        for rpdo in self._sync_rpdos:
            rpdo.apply()
        for tpdo in self._sync_tpdos:
            tpdo.sync()

    # --- loss of the master -------------------------------------------------------------------

    def _on_heartbeat(self, data: bytes) -> None:
        if self._consumer.receive(data):
            self._recover_from(EmcyCode.HEARTBEAT_LOST)

    def _recover_from(self, code: EmcyCode) -> None:
        """The cause is gone; if it made the drive fail, it stays until the fault is reset."""
        if not self.drive.machine.is_faulted:
            self._emergency.clear(code)

    def _lose_connection(self, code: EmcyCode, rpdo: Rpdo | None = None) -> None:
        """React as 6007 says if the drive is powered, and report it in any case."""
        drive = self.drive
        option = self.dictionary.values[key_of(Index.ABORT_CONNECTION_OPTION, 0)]
        if drive.machine.is_powered:
            if option == _FAULT:
                drive.fail(code)
                return
            if option == _DISABLE_VOLTAGE:
                drive.disable_voltage()
            elif option == _QUICK_STOP:
                drive.quick_stop()
        if rpdo is not None:
            rpdo.report(code)
        else:
            self._emergency.raise_error(code)
