"""SDO server in front of an object dictionary, expedited and segmented (CiA 301, 7.2.4.3)."""

from collections.abc import Callable
from dataclasses import dataclass, field

from drivers.cia402.sdo import (
    SdoAbort,
    SdoFrame,
    SdoKind,
    parse_sdo_request,
    sdo_abort,
    sdo_download_response,
    sdo_download_segment_response,
    sdo_upload_response,
    sdo_upload_segment_response,
)
from sim_backend.cia402.dictionary import ObjectDictionary

SEGMENT_BYTES = 7
EXPEDITED_BYTES = 4


@dataclass(slots=True)
class _Transfer:
    """A segmented transfer under way. Downloads fill `data`, uploads empty it."""

    kind: SdoKind
    index: int
    subindex: int
    data: bytearray = field(default_factory=bytearray)
    toggle: int = 0


class SdoServer:
    """Answers one client, one transfer at a time, as the default SDO of a device does."""

    __slots__ = ("_dictionary", "_handlers", "_send", "_transfer")

    def __init__(self, dictionary: ObjectDictionary, send: Callable[[bytes], None]) -> None:
        self._dictionary = dictionary
        self._send = send
        self._transfer: _Transfer | None = None
        self._handlers: dict[SdoKind, Callable[[SdoFrame], None]] = {
            SdoKind.DOWNLOAD: self._start_download,
            SdoKind.UPLOAD: self._start_upload,
            SdoKind.DOWNLOAD_SEGMENT: self._take_segment,
            SdoKind.UPLOAD_SEGMENT: self._give_segment,
            SdoKind.ABORT: self._forget,
            SdoKind.UNKNOWN: self._refuse_command,
        }

    def receive(self, data: bytes) -> None:
        """Answer one request. Anything but 8 bytes is not an SDO and stays unanswered."""
        frame = parse_sdo_request(data)
        if frame is not None:
            self._handlers[frame.kind](frame)

    def reset(self) -> None:
        """Forget a transfer under way."""
        self._transfer = None

    # --- initiation: a new request ends whatever was under way --------------------------------

    def _start_download(self, frame: SdoFrame) -> None:
        self._transfer = None
        index, subindex = frame.index, frame.subindex
        refusal = self._dictionary.check_download(index, subindex, frame.size)
        if refusal is not None:
            self._abort(index, subindex, refusal)
        elif frame.is_expedited:
            self._store(index, subindex, frame.data[: self._dictionary.size_of(index, subindex)])
        else:
            self._transfer = _Transfer(frame.kind, index, subindex)
            self._send(sdo_download_response(index, subindex))

    def _start_upload(self, frame: SdoFrame) -> None:
        self._transfer = None
        value = self._dictionary.upload(frame.index, frame.subindex)
        if isinstance(value, SdoAbort):
            self._abort(frame.index, frame.subindex, value)
            return
        if len(value) > EXPEDITED_BYTES:
            self._transfer = _Transfer(frame.kind, frame.index, frame.subindex, bytearray(value))
        self._send(sdo_upload_response(frame.index, frame.subindex, value))

    # --- segments -----------------------------------------------------------------------------

    def _take_segment(self, frame: SdoFrame) -> None:
        transfer = self._continue(SdoKind.DOWNLOAD, frame)
        if transfer is None:
            return
        transfer.data += frame.data
        index, subindex = transfer.index, transfer.subindex
        size = self._dictionary.size_of(index, subindex)
        if len(transfer.data) > size:
            self._abort(index, subindex, SdoAbort.LENGTH_TOO_HIGH)
        elif not frame.is_last:
            self._send(sdo_download_segment_response(frame.toggle))
        else:
            self._transfer = None
            refusal = self._dictionary.download(index, subindex, bytes(transfer.data))
            if refusal is None:
                self._send(sdo_download_segment_response(frame.toggle))
            else:
                self._abort(index, subindex, refusal)

    def _give_segment(self, frame: SdoFrame) -> None:
        transfer = self._continue(SdoKind.UPLOAD, frame)
        if transfer is None:
            return
        segment = bytes(transfer.data[:SEGMENT_BYTES])
        del transfer.data[:SEGMENT_BYTES]
        is_last = not transfer.data
        if is_last:
            self._transfer = None
        self._send(sdo_upload_segment_response(frame.toggle, segment, is_last=is_last))

    def _continue(self, kind: SdoKind, frame: SdoFrame) -> _Transfer | None:
        """Return the transfer a segment belongs to; None if it was refused."""
        transfer = self._transfer
        if transfer is None or transfer.kind is not kind:
            self._refuse_command(frame)
            return None
        if frame.toggle != transfer.toggle:
            self._abort(transfer.index, transfer.subindex, SdoAbort.TOGGLE)
            return None
        transfer.toggle ^= 1
        return transfer

    # --- endings ------------------------------------------------------------------------------

    def _store(self, index: int, subindex: int, data: bytes) -> None:
        refusal = self._dictionary.download(index, subindex, data)
        if refusal is None:
            self._send(sdo_download_response(index, subindex))
        else:
            self._abort(index, subindex, refusal)

    def _refuse_command(self, frame: SdoFrame) -> None:
        self._abort(frame.index, frame.subindex, SdoAbort.UNKNOWN_COMMAND)

    def _abort(self, index: int, subindex: int, code: SdoAbort) -> None:
        self._transfer = None
        self._send(sdo_abort(index, subindex, code))

    def _forget(self, _frame: SdoFrame) -> None:
        self._transfer = None
