"""SDO client: read and write a drive's object dictionary during start-up (CiA 301, 7.2.4)."""

from struct import Struct

from drivers.axis import Port
from drivers.cia402 import codec
from drivers.cia402.sdo import (
    SdoAbort,
    SdoFrame,
    SdoKind,
    describe_abort,
    parse_sdo_response,
    sdo_abort,
    sdo_download_request,
    sdo_download_segment_request,
    sdo_upload_request,
    sdo_upload_segment_request,
)
from drivers.errors import AmplifierError

SEGMENT_BYTES = 7
VALUE_BYTES_MAX = 1024


class SdoRefusedError(AmplifierError):
    """The drive aborted a transfer; `code` says why."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class SdoClient:
    """Reads and writes objects of one node, one transfer at a time."""

    def __init__(self, port: Port, node_id: int, label: str, timeout_s: float) -> None:
        self._port = port
        self._request_id = codec.COB_SDO_RX + node_id
        self._answer_id = codec.COB_SDO_TX + node_id
        self._label = label
        self._timeout_s = timeout_s

    def read(self, index: int, subindex: int = 0) -> bytes:
        """Return the raw value of an object.

        Raises:
            SdoRefusedError: If the drive aborts the transfer.
            AmplifierError: If it does not answer, or answers out of turn.
        """
        answer = self._ask(sdo_upload_request(index, subindex), index, subindex)
        if answer.kind is not SdoKind.UPLOAD:
            raise self._out_of_turn(answer, index, subindex)
        if answer.is_expedited:
            return answer.data
        value, toggle, size = b"", 0, answer.size
        while len(value) <= VALUE_BYTES_MAX:
            answer = self._ask(sdo_upload_segment_request(toggle), index, subindex)
            if answer.kind is not SdoKind.UPLOAD_SEGMENT or answer.toggle != toggle:
                raise self._out_of_turn(answer, index, subindex)
            value += answer.data
            toggle ^= 1
            is_whole = size is None or len(value) == size
            if not (is_whole if answer.is_last else answer.data):  # too short, too long, endless
                raise self._out_of_turn(answer, index, subindex)
            if answer.is_last:
                return value
        self._port.send(self._request_id, sdo_abort(index, subindex, SdoAbort.OUT_OF_MEMORY))
        raise AmplifierError(
            f"{self._label}: object {index:04X}:{subindex:02X} is longer than "
            f"{VALUE_BYTES_MAX} bytes"
        )

    def read_number(self, layout: Struct, index: int, subindex: int = 0) -> int:
        """Return an integer object; `layout` gives its size and sign.

        Raises:
            AmplifierError: As `read`, or if the value has another length.
        """
        value = self.read(index, subindex)
        if len(value) != layout.size:
            raise AmplifierError(
                f"{self._label}: object {index:04X}:{subindex:02X} has {len(value)} bytes, "
                f"expected {layout.size}"
            )
        number: int = layout.unpack(value)[0]
        return number

    def write(self, index: int, subindex: int, value: bytes) -> None:
        """Write an object.

        Raises:
            SdoRefusedError: If the drive aborts the transfer.
            AmplifierError: If it does not answer, or answers out of turn.
        """
        request = sdo_download_request(index, subindex, value)
        answer = self._ask(request, index, subindex)
        if answer.kind is not SdoKind.DOWNLOAD:
            raise self._out_of_turn(answer, index, subindex)
        if 1 <= len(value) <= 4:
            return
        toggle = 0
        for start in range(0, len(value), SEGMENT_BYTES):
            part = value[start : start + SEGMENT_BYTES]
            is_last = start + SEGMENT_BYTES >= len(value)
            frame = sdo_download_segment_request(toggle, part, is_last=is_last)
            answer = self._ask(frame, index, subindex)
            if answer.kind is not SdoKind.DOWNLOAD_SEGMENT or answer.toggle != toggle:
                raise self._out_of_turn(answer, index, subindex)
            toggle ^= 1

    def _ask(self, request: bytes, index: int, subindex: int) -> SdoFrame:
        self._port.send(self._request_id, request)
        data = self._port.wait(self._answer_id, self._timeout_s)
        if data is None:
            raise AmplifierError(
                f"{self._label}: no SDO answer for {index:04X}:{subindex:02X} within "
                f"{self._timeout_s:g} s; check power, node-ID and bit rate"
            )
        answer = parse_sdo_response(data)
        if answer is None or answer.kind is SdoKind.UNKNOWN:
            raise AmplifierError(f"{self._label}: not an SDO answer: {data.hex(' ')}")
        if answer.kind is SdoKind.ABORT:
            reason = describe_abort(answer.abort_code)
            raise SdoRefusedError(
                f"{self._label}: object {index:04X}:{subindex:02X} refused: {reason}",
                answer.abort_code,
            )
        names_object = answer.kind in (SdoKind.UPLOAD, SdoKind.DOWNLOAD)
        if names_object and (answer.index, answer.subindex) != (index, subindex):
            raise self._out_of_turn(answer, index, subindex)
        return answer

    def _out_of_turn(self, answer: SdoFrame, index: int, subindex: int) -> AmplifierError:
        self._port.send(self._request_id, sdo_abort(index, subindex, SdoAbort.GENERAL))
        return AmplifierError(
            f"{self._label}: object {index:04X}:{subindex:02X}: unexpected SDO {answer.kind.value}"
        )
