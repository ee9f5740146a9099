"""Start-up conversation with one ODrive axis: who it is, its parameters written and read back."""

from collections.abc import Callable
from typing import TypeVar

from drivers.axis import Port
from drivers.errors import AmplifierError
from drivers.odrive import codec, endpoints
from drivers.odrive.codec import AxisError, AxisState, Command, Heartbeat, Version
from drivers.odrive.endpoints import LAYOUT, Endpoint, EndpointTable

OTHER_MASTER_S = 0.02
"""How long to listen for torque frames of another master."""
HEARTBEATS_WHILE_BOOTING = 50
STRAY_FRAMES = 100
"""Answers to somebody else, or for another endpoint, that are passed over."""

Parsed = TypeVar("Parsed")


class OdriveService:
    """Requests to one axis, each waited for; only for start-up.

    Args:
        port: The bus.
        node: CANSimple node id.
        label: How messages name the axis.
        timeout_s: Longest wait for one answer.
    """

    def __init__(self, port: Port, node: int, label: str, timeout_s: float) -> None:
        self._port = port
        self._node = node
        self._label = label
        self._timeout_s = timeout_s
        self.table = endpoints.EMULATED

    def refuse_other_master(self) -> None:
        """Listen for torque frames that are not ours.

        Raises:
            AmplifierError: If there are any.
        """
        torque_id = codec.can_id(self._node, Command.INPUT_TORQUE)
        if self._port.wait(torque_id, OTHER_MASTER_S) is not None:
            raise AmplifierError(
                f"{self._label}: another master sends it torque; stop the other daemon first"
            )

    def wait_until_booted(self, heartbeat_ms: int) -> Heartbeat:
        """Return the first heartbeat of a drive that is up.

        Raises:
            AmplifierError: If there is none in time.
        """
        heartbeat_id = codec.can_id(self._node, Command.HEARTBEAT)
        timeout_s = max(3e-3 * heartbeat_ms, self._timeout_s)
        for _ in range(HEARTBEATS_WHILE_BOOTING):
            data = self._port.wait(heartbeat_id, timeout_s)
            if data is None:
                break
            beat = codec.parse_heartbeat(data)
            if beat is not None and not beat.errors & AxisError.INITIALIZING:
                return beat
        raise AmplifierError(
            f"{self._label}: no heartbeat within {timeout_s:g} s; check power, bit rate, node_id "
            "and axis0.config.can.heartbeat_msg_rate_ms"
        )

    def require_rate(self, command: Command, interval_ms: int, setting: str) -> None:
        """Listen for a cyclic message that was set up by hand.

        Raises:
            AmplifierError: If two in a row do not come within three times its interval each.
        """
        for _ in range(2):
            if self._port.wait(codec.can_id(self._node, command), 3e-3 * interval_ms) is None:
                raise AmplifierError(
                    f"{self._label}: sends no 0x{command:02X} every {interval_ms} ms; correct "
                    f"{setting}"
                )

    def version(self) -> Version:
        """Ask for the version.

        Nothing else may be asked before: to firmware 0.5 the frame that asks for the address means
        `set the node id`.

        Raises:
            AmplifierError: If it does not answer or is older than 0.6.
        """
        version = self._ask(Command.VERSION, codec.parse_version)
        if version is None or version.firmware < (0, 6, 0):
            found = "does not tell its version" if version is None else shown(version.firmware)
            raise AmplifierError(
                f"{self._label}: firmware {found}; CANSimple of firmware 0.6 or newer is needed"
            )
        return version

    def serial(self) -> int:
        """Ask for the serial number.

        Raises:
            AmplifierError: If it does not answer, or reports another node id.
        """
        address = self._ask(Command.ADDRESS, codec.parse_address)
        if address is None or address.node != self._node:
            raise AmplifierError(f"{self._label}: does not answer 0x06 with its node id")
        return address.serial

    def position_rev(self) -> float:
        """Ask for the position.

        Raises:
            AmplifierError: If there is no finite one.
        """
        estimates = self._ask(Command.ENCODER, codec.parse_f32_pair)
        if estimates is None or not abs(estimates[0]) <= codec.POSITION_MAX_REV:
            raise AmplifierError(
                f"{self._label}: has no position estimate ({estimates and estimates[0]}); "
                "check its encoder"
            )
        return estimates[0]

    def is_lockstep(self, serial: int) -> bool:
        """Tell whether it is emulated, and its time advances with the master's lockstep frame."""
        if serial & 0xFF_FFFF != endpoints.EMULATED_SERIAL:
            return False
        request = codec.Sdo(codec.OPCODE_READ, endpoints.TIME_BASE_ID, b"")
        value = self._exchange(request)
        return value is not None and value[:1] == b"\x01"

    def set(self, endpoint: Endpoint, value: float) -> None:
        """Write a parameter and read it back.

        Raises:
            AmplifierError: If it does not answer or keeps another value.
        """
        table = self.table
        self._send(Command.RX_SDO, table.write(endpoint, value))
        wanted = LAYOUT[endpoint].unpack(LAYOUT[endpoint].pack(value))[0]
        found = self.get(endpoint)
        if found != wanted:
            raise AmplifierError(
                f"{self._label}: {endpoint.value} reads back as {found:g} after {wanted:g} was "
                "written; is the endpoints file that of its firmware?"
            )

    def get(self, endpoint: Endpoint) -> float:
        """Read a parameter.

        Raises:
            AmplifierError: If it does not answer.
        """
        request = codec.Sdo(codec.OPCODE_READ, self.table.ids[endpoint], b"")
        value = self._exchange(request, LAYOUT[endpoint].size)
        if value is None:
            raise AmplifierError(f"{self._label}: does not answer a read of {endpoint.value}")
        return float(LAYOUT[endpoint].unpack_from(value)[0])

    def clear_errors(self) -> None:
        """Clear all errors; answered by nothing."""
        self._send(Command.CLEAR_ERRORS, b"\0")

    def _exchange(self, request: codec.Sdo, size: int = 1) -> bytes | None:
        """Return the value of a read endpoint; a confirmation of a write (0.6.11) has none."""
        self._send(Command.RX_SDO, codec.pack_sdo(request))
        answer_id = codec.can_id(self._node, Command.TX_SDO)
        for _ in range(STRAY_FRAMES):
            data = self._port.wait(answer_id, self._timeout_s)
            if data is None:
                return None
            answer = codec.parse_sdo(data)
            if answer is None or answer.endpoint != request.endpoint or len(answer.value) < size:
                continue
            return answer.value
        return None

    def _ask(self, command: Command, parse: Callable[[bytes], Parsed | None]) -> Parsed | None:
        """Send an empty frame, which asks for the value as a remote request does."""
        self._send(command, b"")
        for _ in range(STRAY_FRAMES):
            data = self._port.wait(codec.can_id(self._node, command), self._timeout_s)
            if data is None:
                return None
            if (parsed := parse(data)) is not None:
                return parsed
        return None

    def _send(self, command: Command, data: bytes) -> None:
        self._port.send(codec.can_id(self._node, command), data)


def refuse_unless_idle(label: str, beat: Heartbeat) -> None:
    """Check a heartbeat at start-up.

    Raises:
        AmplifierError: If the axis is in any state but IDLE.
    """
    if beat.state == AxisState.IDLE:
        return
    what = (
        "is already enabled, perhaps by another master; disable it"
        if beat.state == AxisState.CLOSED_LOOP_CONTROL
        else f"is in {codec.describe_state(beat.state)}; wait for its end"
    )
    raise AmplifierError(f"{label}: {what} before starting")


def choose_table(label: str, path: str | None, version: Version) -> EndpointTable:
    """Return the endpoint numbers of a drive's firmware.

    Raises:
        AmplifierError: If they are not known.
    """
    table = load_endpoints(path)
    if version[1:3] == (table.hardware, table.firmware):
        return table
    found = f"firmware {shown(version.firmware)} on hardware {shown(version.hardware)}"
    if path is None:
        raise AmplifierError(
            f"{label}: the endpoint numbers of {found} are needed to set its watchdog; put the "
            "vendor's flat_endpoints.json in endpoints_file, or store the watchdog in the drive by "
            "hand and set parameters = 'preset'"
        )
    raise AmplifierError(
        f"{label}: {path} is for firmware {shown(table.firmware)} on hardware "
        f"{shown(table.hardware)}, the drive has {found}"
    )


def load_endpoints(path: str | None) -> EndpointTable:
    """Return the numbers in a file; those of the emulated drive if there is none."""
    return endpoints.EMULATED if path is None else endpoints.load_endpoints(path)


def shown(version: tuple[int, int, int]) -> str:
    """Write a version with dots."""
    return ".".join(str(part) for part in version)
