"""Master side of one CiA 402 drive in cyclic synchronous torque mode (CST)."""

import math

from drivers.axis import Axis, AxisInfo, AxisStatus, FrameHandler, Port
from drivers.cia402 import codec
from drivers.cia402.codec import Cia402State, Index
from drivers.cia402.sdo import sdo_download_request
from drivers.cia402.sdo_client import SdoClient, SdoRefusedError
from drivers.cia402.settings import Cia402Settings
from drivers.errors import AmplifierError
from drivers.frame import pack_frame, unpack_frame

HIL_PRODUCT_CODE = 0x48494C31
"""1018:02 of the emulated drive; only there has 2F00 the meaning `time base`."""
PLAUSIBLE_TURN = 0.125
"""No joint turns so far between two readings; after one that says so, turns are counted anew."""
RESET_CYCLES = 10
"""Cycles for which the fault-reset edge is held."""
HEARTBEATS_BEFORE_BOOT_UP = 8
"""Heartbeats that may still arrive between a reset and the boot-up message."""
DEAF_CYCLES = 3
"""Commands to remove power after which a drive that was enabled and says nothing is stopped."""
STOP_EVERY = 50
"""Commands between two such stops, while the drive goes on saying nothing."""
RESTING_TORQUE = 0
TORQUE_OBJECT_MAX = 0x7FFF
"""Largest per mille that 6071 and 6077 hold."""
ROUNDING = 1.0 + 1e-12
"""A limit that is a whole number of per mille stays one, in spite of binary fractions."""
_POWER_UP = {  # towards power: drive state -> controlword
    Cia402State.SWITCH_ON_DISABLED: codec.CONTROL_SHUTDOWN,
    Cia402State.READY_TO_SWITCH_ON: codec.CONTROL_SWITCH_ON,
    Cia402State.SWITCHED_ON: codec.CONTROL_ENABLE_OPERATION,
    Cia402State.OPERATION_ENABLED: codec.CONTROL_ENABLE_OPERATION,
}


class Cia402Axis(Axis):
    """One CANopen drive: start-up by SDO, then RPDO1/TPDO1 around each SYNC.

    Torque sent in one cycle takes effect at the SYNC of the next.
    """

    uses_sync = True

    def __init__(
        self, settings: Cia402Settings, *, joint: int, period_s: float, master_id: int = 127
    ) -> None:
        super().__init__(f"joint {joint} (cia402 node {settings.node_id})")
        self._settings = settings
        self._period_s = period_s
        self._master_id = master_id
        node = settings.node_id
        self._command_head = pack_frame(codec.COB_RPDO1 + node, bytes(4))[:8]
        rated_Nm = round(settings.rated_torque_Nm * 1e3) / 1e3 or 1e-3  # as 6076 has it, in mNm
        self._per_mille_per_Nm = settings.direction * 1000.0 / rated_Nm
        self._torque_max = math.floor(1000.0 * settings.torque_max_Nm / rated_Nm * ROUNDING)
        self._rad_per_count = settings.direction * math.tau / settings.counts_per_turn
        self._range_counts = 0
        self._position: int | None = None
        self._counts = 0
        self._plausible_step = round(PLAUSIBLE_TURN * settings.counts_per_turn)
        self._is_count_doubtful = False
        self._statusword = -1
        self._controlword = codec.CONTROL_DISABLE_VOLTAGE
        self._wants_power = False
        self._reset_cycles = 0
        self._deaf_cycles = 0
        self._is_stopped = False
        self._heartbeat_limit = math.ceil(3e-3 * settings.heartbeat_ms / period_s)
        self._heartbeat_age = 0

    # --- start-up ---------------------------------------------------------------------------

    def configure(self, port: Port) -> AxisInfo:
        """Boot the node, check its scales, map its PDOs; see `Axis.configure`."""
        self._refuse_torque_limit_out_of_range()
        sdo = SdoClient(port, self._settings.node_id, self.label, self._settings.sdo_timeout_s)
        self._refuse_if_enabled(sdo)
        self._boot(port)
        name = self._read_name(sdo)
        is_emulated, is_lockstep = self._time_base(sdo)
        self._check_scales(sdo)
        self._write_profile(sdo)
        self._map_pdos(sdo)
        s = self._settings
        torque_Nm, angle_rad = s.rated_torque_Nm / 1000.0, math.tau / s.counts_per_turn
        return AxisInfo(name, torque_Nm, angle_rad, is_lockstep, is_emulated)

    def start(self, port: Port) -> None:
        """Switch the node to OPERATIONAL."""
        start = codec.pack_nmt(codec.NmtCommand.START, self._settings.node_id)
        port.send(codec.COB_NMT, start)

    def _refuse_torque_limit_out_of_range(self) -> None:
        s = self._settings
        if not 1 <= self._torque_max <= TORQUE_OBJECT_MAX:
            unit_Nm = s.rated_torque_Nm / 1000.0
            raise AmplifierError(
                f"{self.label}: torque_max_Nm {s.torque_max_Nm:g} is outside {unit_Nm:g} to "
                f"{TORQUE_OBJECT_MAX * unit_Nm:g} Nm, what 6072 holds at rated_torque_Nm "
                f"{s.rated_torque_Nm:g}; correct one of them"
            )

    def _refuse_if_enabled(self, sdo: SdoClient) -> None:
        statusword = sdo.read_number(codec.U16, Index.STATUSWORD)
        if codec.decode_state(statusword) is Cia402State.OPERATION_ENABLED:
            raise AmplifierError(
                f"{self.label}: is already enabled (statusword {statusword:04X}), perhaps by "
                "another master; disable it before starting"
            )

    def _boot(self, port: Port) -> None:
        node = self._settings.node_id
        port.send(codec.COB_NMT, codec.pack_nmt(codec.NmtCommand.RESET_COMMUNICATION, node))
        if not self._sees_boot_up(port):
            raise AmplifierError(f"{self.label}: no boot-up message after a communication reset")
        port.send(codec.COB_NMT, codec.pack_nmt(codec.NmtCommand.ENTER_PRE_OPERATIONAL, node))

    def _sees_boot_up(self, port: Port) -> bool:
        can_id = codec.COB_HEARTBEAT + self._settings.node_id
        for _ in range(HEARTBEATS_BEFORE_BOOT_UP):
            data = port.wait(can_id, self._settings.sdo_timeout_s)
            if data is None:
                return False
            if codec.parse_heartbeat(data) is codec.NmtState.INITIALISING:
                return True
        return False

    @staticmethod
    def _read_name(sdo: SdoClient) -> str:
        try:
            return sdo.read(Index.DEVICE_NAME).decode("ascii", "replace")
        except SdoRefusedError:  # 1008 is optional
            return "unnamed"

    @staticmethod
    def _time_base(sdo: SdoClient) -> tuple[bool, bool]:
        """Return whether the drive is emulated, and whether it runs in lockstep."""
        try:
            if sdo.read_number(codec.U32, Index.IDENTITY, 2) != HIL_PRODUCT_CODE:
                return False, False
        except SdoRefusedError:
            return False, False
        return True, sdo.read_number(codec.U8, Index.TIME_BASE) == 1

    def _check_scales(self, sdo: SdoClient) -> None:
        s = self._settings
        if not sdo.read_number(codec.U32, Index.SUPPORTED_MODES) & codec.CST_SUPPORTED:
            raise AmplifierError(f"{self.label}: does not offer cyclic synchronous torque (6502)")
        self._require("rated torque 6076 [mNm]", sdo.read_number(codec.U32, Index.RATED_TORQUE),
                      round(s.rated_torque_Nm * 1000.0), "rated_torque_Nm")  # fmt: skip
        counts = sdo.read_number(codec.U32, Index.ENCODER_RESOLUTION, 1)
        turns = sdo.read_number(codec.U32, Index.ENCODER_RESOLUTION, 2)
        self._require("encoder resolution 608F [counts/turn]", counts // max(turns, 1),
                      s.counts_per_turn, "counts_per_turn")  # fmt: skip
        try:
            low = sdo.read_number(codec.I32, Index.POSITION_RANGE, 1)
            high = sdo.read_number(codec.I32, Index.POSITION_RANGE, 2)
        except SdoRefusedError:  # optional: without it the position counts on, over 32 bits
            low = high = 0
        self._range_counts = high - low + 1 if high > low else 1 << 32

    def _require(self, what: str, found: int, wanted: int, setting: str) -> None:
        if found != wanted:
            raise AmplifierError(
                f"{self.label}: {what} is {found}, the configuration says {wanted}; "
                f"correct {setting}"
            )

    def _write_profile(self, sdo: SdoClient) -> None:
        s = self._settings
        watch = codec.consumer_heartbeat(self._master_id, 3 * s.heartbeat_ms)
        sdo.write(Index.MODE, 0, codec.I8.pack(codec.CST))
        sdo.write(Index.CYCLE_TIME, 1, codec.U8.pack(max(1, round(self._period_s * 1e3))))
        sdo.write(Index.CYCLE_TIME, 2, codec.I8.pack(-3))
        sdo.write(Index.MAX_TORQUE, 0, codec.U16.pack(self._torque_max))
        sdo.write(Index.ABORT_CONNECTION_OPTION, 0, codec.I16.pack(1))
        sdo.write(Index.PRODUCER_HEARTBEAT, 0, codec.U16.pack(s.heartbeat_ms))
        sdo.write(Index.CONSUMER_HEARTBEAT, 1, codec.U32.pack(watch))
        found = sdo.read_number(codec.U16, Index.MAX_TORQUE)
        self._require("torque limit 6072 [per mille]", found, self._torque_max, "torque_max_Nm")
        mode = sdo.read_number(codec.I8, Index.MODE_DISPLAY)
        if mode != codec.CST:
            raise AmplifierError(
                f"{self.label}: mode of operation 6061 is {mode}, although 6060 was set to "
                f"{codec.CST}; let the drive be controlled over CANopen"
            )

    def _map_pdos(self, sdo: SdoClient) -> None:
        node = self._settings.node_id
        deadline = codec.U16.pack(self._settings.rpdo_timeout_ms)
        _map_pdo(sdo, Index.RPDO1_PARAMETER, codec.COB_RPDO1 + node, codec.RPDO1_MAP)
        sdo.write(Index.RPDO1_PARAMETER, 5, deadline)
        _map_pdo(sdo, Index.TPDO1_PARAMETER, codec.COB_TPDO1 + node, codec.TPDO1_MAP)
        sdo.write(Index.TPDO2_PARAMETER, 1, codec.U32.pack(codec.PDO_OFF | codec.COB_TPDO2 + node))

    # --- in operation -----------------------------------------------------------------------

    def handlers(self) -> dict[int, FrameHandler]:
        """TPDO1, heartbeat and EMCY of this node."""
        node = self._settings.node_id
        return {
            codec.COB_TPDO1 + node: self._on_tpdo1,
            codec.COB_HEARTBEAT + node: self._on_heartbeat,
            codec.COB_EMCY + node: self._on_emcy,
        }

    def command(self, tau_Nm: float) -> bytes:
        """RPDO1: controlword, and torque when the drive is enabled and is to stay so."""
        torque = RESTING_TORQUE
        if self._reset_cycles:
            if self._is_stopped:
                self._is_stopped = False
                return self._nmt_frame(codec.NmtCommand.START)
            self._step_reset()
        elif self.status is AxisStatus.ENABLED and self._wants_power:
            wanted = round(tau_Nm * self._per_mille_per_Nm)
            torque = max(-self._torque_max, min(self._torque_max, wanted))
        elif self.status is AxisStatus.ENABLED and self.age_cycles > 0 and self._is_deaf():
            return self._nmt_frame(codec.NmtCommand.ENTER_PRE_OPERATIONAL)
        return self._command_head + codec.RPDO1.pack(self._controlword, torque) + b"\0\0\0\0"

    def _is_deaf(self) -> bool:
        """Count a command to remove power that nothing shows the effect of; True if to be stopped.

        Without SYNC an RPDO has no effect, not even one that ends torque, while every RPDO that
        arrives keeps the drive's own deadline (1400:05) from acting. Leaving OPERATIONAL needs no
        SYNC, and ends torque by 6007.
        """
        self._deaf_cycles += 1
        is_due = self._deaf_cycles % STOP_EVERY == DEAF_CYCLES
        self._is_stopped = self._is_stopped or is_due
        return is_due

    def _nmt_frame(self, command: codec.NmtCommand) -> bytes:
        return pack_frame(codec.COB_NMT, codec.pack_nmt(command, self._settings.node_id))

    def enable(self) -> None:
        """Ask for power: 06, 07, 0F as the drive's state allows."""
        self._wants_power = True
        self._deaf_cycles = 0
        self._choose_controlword()

    def disable(self) -> None:
        """Ask for torque off: controlword 00, disable voltage; unheard, NMT ends it."""
        self._wants_power = False
        self._choose_controlword()

    def reset_fault(self) -> None:
        """Send 00, then a rising edge of bit 7; also forgives a heartbeat that was lost."""
        self._wants_power = False
        self._heartbeat_age = 0
        self.note = ""
        self._reset_cycles = RESET_CYCLES + 1
        self.status = AxisStatus.DISABLED
        self._statusword = -1  # look at the next one afresh

    def recount(self) -> None:
        """See `Axis.recount`."""
        if self._is_count_doubtful:
            self._is_count_doubtful = False
            self._position = None

    def end_cycle(self) -> None:
        """Count the silence since the last heartbeat."""
        self._heartbeat_age += 1
        if self._heartbeat_age > self._heartbeat_limit and self.status is not AxisStatus.LOST:
            self.status = AxisStatus.LOST
            self.note = f"{self.label}: no heartbeat for {self._heartbeat_age} cycles"
            self.disable()

    def inject_fault(self) -> bytes:
        """SDO write to 2F01, which only the emulated drive has; a real one refuses it."""
        request = sdo_download_request(Index.INJECT_FAULT, 0, b"\x01")
        return pack_frame(codec.COB_SDO_RX + self._settings.node_id, request)

    def _on_tpdo1(self, frame: bytes) -> bool:
        if frame[4] != codec.TPDO1.size:
            return False
        statusword, position, torque = codec.TPDO1.unpack_from(frame, 8)
        if position != self._position:
            self._take_position(position)
        self.tau_meas_Nm = torque / self._per_mille_per_Nm
        if statusword != self._statusword:
            self._take_statusword(statusword)
        is_first = self.age_cycles > 0
        self.age_cycles = 0
        return is_first

    def _take_position(self, position: int) -> None:
        if self._position is None:
            half_turn = self._settings.counts_per_turn // 2
            turns = math.floor((position + half_turn) / self._settings.counts_per_turn)
            self._counts = position - turns * self._settings.counts_per_turn
            start = self._counts * self._rad_per_count + self._settings.offset_rad
            excess = round(start / math.tau)  # an offset may not push the start out of +-pi
            self._counts -= excess * self._settings.counts_per_turn * self._settings.direction
        else:
            half = self._range_counts // 2
            step = (position - self._position + half) % self._range_counts - half
            self._counts += step
            if not -self._plausible_step <= step <= self._plausible_step:
                self._is_count_doubtful = True
        self._position = position
        self.q_rad = self._counts * self._rad_per_count + self._settings.offset_rad

    def _take_statusword(self, statusword: int) -> None:
        self._statusword = statusword
        state = codec.decode_state(statusword)
        if self.status is AxisStatus.LOST:
            return
        if state is Cia402State.OPERATION_ENABLED:
            self.status = AxisStatus.ENABLED
        elif state in (Cia402State.FAULT, Cia402State.FAULT_REACTION_ACTIVE):
            if self._reset_cycles:  # the reset is on its way: judge the next statusword
                self._statusword = -1
                return
            self.status = AxisStatus.FAULT
            self._wants_power = False
            self.note = self.note or f"{self.label}: drive fault (statusword {statusword:04X})"
        else:
            if self.status is AxisStatus.ENABLED:  # power went off: only `enable` may ask again
                self._wants_power = False
            self.status = AxisStatus.DISABLED
        self._choose_controlword()

    def _choose_controlword(self) -> None:
        if not self._wants_power:
            self._controlword = codec.CONTROL_DISABLE_VOLTAGE
            return
        state = codec.decode_state(self._statusword)
        self._controlword = _POWER_UP.get(state, codec.CONTROL_DISABLE_VOLTAGE)

    def _step_reset(self) -> None:
        is_edge = self._reset_cycles <= RESET_CYCLES
        self._reset_cycles -= 1
        self._controlword = codec.CONTROL_FAULT_RESET if is_edge else codec.CONTROL_DISABLE_VOLTAGE
        if self._reset_cycles == 0:
            self._choose_controlword()

    def _on_heartbeat(self, frame: bytes) -> bool:
        state = codec.parse_heartbeat(unpack_frame(frame)[1])
        if state is codec.NmtState.OPERATIONAL:
            self._heartbeat_age = 0
            if self.status is AxisStatus.LOST:
                self.status = AxisStatus.DISABLED  # the loop has latched the loss by now
                self._statusword = -1
        elif state is codec.NmtState.INITIALISING:
            self.status = AxisStatus.LOST
            self.note = f"{self.label}: restarted by itself (boot-up message)"
            self._heartbeat_age = self._heartbeat_limit + 1
            self.disable()
        return False

    def _on_emcy(self, frame: bytes) -> bool:
        emcy = codec.parse_emcy(unpack_frame(frame)[1])
        if emcy is not None and emcy.code != codec.EmcyCode.ERROR_RESET:
            self.note = (
                f"{self.label}: EMCY {emcy.code:04X}, error register {emcy.error_register:02X}"
            )
        return False


def _map_pdo(sdo: SdoClient, parameter: int, cob_id: int, entries: tuple[int, ...]) -> None:
    """Map one PDO, synchronous every SYNC: off, type, count 0, entries, count, on (7.5.2.36)."""
    mapping = parameter + 0x200
    sdo.write(parameter, 1, codec.U32.pack(codec.PDO_OFF | cob_id))
    sdo.write(parameter, 2, codec.U8.pack(1))
    sdo.write(mapping, 0, codec.U8.pack(0))
    for number, word in enumerate(entries, start=1):
        sdo.write(mapping, number, codec.U32.pack(word))
    sdo.write(mapping, 0, codec.U8.pack(len(entries)))
    sdo.write(parameter, 1, codec.U32.pack(cob_id))
