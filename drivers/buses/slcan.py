"""slcan: a serial CAN adapter that speaks LAWICEL, or the pty of an emulated one.

Frames cost 5 to 26 characters (11-bit) on the line. `slcan_codec` turns them into records;
here are the port, the two queues, and the adapter's answers.
"""

from collections import deque
from dataclasses import dataclass
from time import monotonic

from drivers.bus import BusStats
from drivers.buses.serial_line import SerialBus
from drivers.buses.slcan_codec import (
    BIT_RATES_Hz,
    LineSplitter,
    StatusFlags,
    decode_frame,
    decode_report,
    decode_status,
    encode_frame,
    split_timestamp,
)
from drivers.buses.slcan_port import SlcanAddress, open_port
from drivers.errors import BusError
from drivers.frame import ERR_BIT, FLAGS_INDEX

WINDOW_FRAMES = 64
"""With acknowledgements, so many frames may wait for theirs; the next one is lost."""
ANSWER_TIMEOUT_S = 0.1
"""What an adapter gets for an answer. Some never answer set-up commands, and work."""

_QUIET_S = 0.02  # nothing for so long after C: the adapter has closed its channel
_DRAIN_LIMIT_S = 0.5
_ACKNOWLEDGEMENTS = frozenset({b"", b"z", b"Z"})
_REFUSAL = b"\a"
_CLOSE = b"C\r"
_RESTART = b"\r\r\r" + _CLOSE  # CRs end whatever line an earlier program left begun


@dataclass(slots=True)
class SlcanStats(BusStats):
    """Counters of the adapter's answers besides those every bus has."""

    acknowledged: int = 0
    """Answers CR, z or Z."""
    refused: int = 0
    """Answers BEL; each also counts as a frame lost, in `send_failures`."""
    unanswered: int = 0
    """With acknowledgements: frames of which the adapter never said what became of them."""


class SlcanBus(SerialBus):
    """An adapter on a serial port or pty; this program alone uses it.

    Opening closes the adapter's channel, sets the bit rate and opens it again. Adapters answer
    these commands or keep silent; only with `ack` in the address is silence an error. After a
    BusError in use (unplugged), open a new one.

    Args:
        address: `DEVICE[@BITRATE][,baud=N][,ack][,listen][,timestamps]`; see `SlcanAddress`.

    Attributes:
        stats: Lines that are neither frame nor answer are its `malformed_records`.
        timestamp_ms: With `timestamps`, the adapter's time of the frame last received, 0 to
            59999; None for a frame without one.

    Raises:
        BusAddressError: If the address cannot be understood.
        BusError: If the port is missing or in use, or the adapter refuses a command.
    """

    stats: SlcanStats
    carries_fd = False

    def __init__(self, address: str) -> None:
        self.address = SlcanAddress.parse(address)
        super().__init__(open_port(self.address), f"slcan:{self.address.device}")
        self.stats = SlcanStats()
        self.timestamp_ms: int | None = None
        self._is_listening = self.address.is_listening
        self._has_acks = False  # the set-up's own answers are not a frame's
        self._unacknowledged = 0
        self._answered_s = 0.0
        self._lines = LineSplitter()
        self._stamps: deque[int | None] = deque()
        self._answers: dict[bytes, bytes] = {}
        try:
            self._start()
        except BaseException:
            self.close()
            raise

    def send(self, frame: bytes) -> bool:
        """Hand one frame to the port; see `Bus.send`.

        A line that the port takes only in part is completed by the calls that follow. Error
        reports and what is no classic frame cannot be sent: lost, and counted.

        Raises:
            BusError: If the port is gone, or was opened to listen.
        """
        line = encode_frame(frame)
        if self._is_listening:
            raise BusError(f"the bus {self._name} was opened to listen, not to send")
        if line and (not self._has_acks or self._has_room()) and self._put(line):
            self._unacknowledged += self._has_acks
            self.stats.frames_sent += 1
            return True
        if self._fd < 0:
            self._raise_gone(None)
        self.stats.send_failures += 1
        return False

    def recv(self, timeout_s: float) -> bytes | None:
        """Return the next frame, waiting at most `timeout_s`; see `Bus.recv`."""
        frames = self._frames
        if not frames:
            if self._pending:
                self._flush()
            if self._poll(0):
                self._read()
            if not frames and (timeout_s <= 0.0 or not self._await(timeout_s)):
                return None
        frame = frames.popleft()
        if self._stamps:
            self.timestamp_ms = self._stamps.popleft()
        self.stats.frames_received += 1
        if frame[FLAGS_INDEX] & ERR_BIT:
            self._count_error_report()
        return frame

    def close(self) -> None:
        """Close the adapter's channel and leave the port."""
        self._pending += _CLOSE
        self._stamps.clear()
        super().close()

    def read_status(self) -> StatusFlags | None:
        """Ask the adapter for its flags (`F`), which clears them; None if it does not answer.

        Waits for `ANSWER_TIMEOUT_S` at most: not for the control loop.
        """
        answer = self._ask(b"F")
        return decode_status(answer) if answer is not None else None

    def read_version(self) -> str | None:
        """Ask the adapter for its versions (`V`): `1013` is hardware 1.0, software 1.3."""
        return self._ask_text(b"V")

    def read_serial(self) -> str | None:
        """Ask the adapter for its serial number (`N`)."""
        return self._ask_text(b"N")

    # --- lines from the adapter

    def _sort(self, chunk: bytes) -> None:
        splitter = self._lines
        lines = splitter.feed(chunk)
        if splitter.overlong:
            self.stats.malformed_records += splitter.overlong
            splitter.overlong = 0
        if self.address.has_timestamps:
            self._take_stamped(lines)
            return
        append = self._frames.append
        for line in lines:
            frame = decode_frame(line)
            if frame is not None:
                append(frame)
            else:
                self._take_other(line)

    def _take_stamped(self, lines: list[bytes]) -> None:
        for line in lines:
            bare, stamp_ms = split_timestamp(line)
            frame = decode_frame(bare)
            if frame is None:
                frame, stamp_ms = decode_frame(line), None
            if frame is not None:
                self._frames.append(frame)
                self._stamps.append(stamp_ms)
            else:
                self._take_other(line)

    def _take_other(self, line: bytes) -> None:
        """Sort a line that is no frame: an answer, a report, a frame with a stamp, or garbage."""
        if line in _ACKNOWLEDGEMENTS:
            self.stats.acknowledged += 1
            self._note_answer(line)
        elif line[-1:] == _REFUSAL:
            self._take_refusal(line)
        elif line[:1] in (b"F", b"V", b"N"):
            self._answers[line[:1]] = line
        else:
            frame = decode_report(line) or decode_frame(split_timestamp(line)[0])
            if frame is None:
                self.stats.malformed_records += 1
                return
            self._frames.append(frame)
            if self.address.has_timestamps:
                self._stamps.append(None)

    def _take_refusal(self, line: bytes) -> None:
        self.stats.malformed_records += len(line) > 1  # the beginning of a line that BEL cut off
        self.stats.refused += 1
        self.stats.send_failures += 1
        self._note_answer(_REFUSAL)

    def _note_answer(self, answer: bytes) -> None:
        self._answers[b""] = answer
        if self._unacknowledged:
            self._unacknowledged -= 1
            self._answered_s = monotonic()

    def _has_room(self) -> bool:
        """Look for acknowledgements if too many are missing, and give up those overdue."""
        if not self._unacknowledged:
            self._answered_s = monotonic()
        if self._unacknowledged < WINDOW_FRAMES:
            return True
        if self._poll(0):
            self._read()
        if self._unacknowledged < WINDOW_FRAMES:
            return True
        if monotonic() - self._answered_s < ANSWER_TIMEOUT_S:
            return False
        self.stats.unanswered += self._unacknowledged
        self._unacknowledged = 0
        return True

    # --- set-up

    def _start(self) -> None:
        address = self.address
        self._command(_RESTART)
        self._drain()
        if address.has_timestamps:
            self._set(b"Z1", "time stamps")
        self._set(BIT_RATES_Hz[address.bit_rate_Hz], f"{address.bit_rate_Hz} bit/s")
        self._set(b"L" if address.is_listening else b"O", "to open its channel")
        self.stats = SlcanStats()  # only what comes after the set-up
        self._has_acks = address.has_acks

    def _drain(self) -> None:
        """Read until the adapter keeps quiet, then forget it all: it was meant for others."""
        deadline_s = monotonic() + _DRAIN_LIMIT_S
        while self._exchange(_QUIET_S) and monotonic() < deadline_s:
            pass
        self._lines.reset()
        self._frames.clear()
        self._stamps.clear()

    def _set(self, command: bytes, what: str) -> None:
        answer = self._ask(command, b"")
        name = f"the adapter at {self._name}"
        if answer == _REFUSAL:
            raise BusError(f"{name} refuses {what} (command {command.decode()})")
        if answer is None and self.address.has_acks:
            raise BusError(
                f"{name} does not answer {command.decode()} within {ANSWER_TIMEOUT_S:g} s; "
                "is it an adapter, and the serial speed right? Leave `ack` out if it never answers"
            )

    def _ask(self, command: bytes, kind: bytes | None = None) -> bytes | None:
        """Send a command; return the answer of this kind (its own letter by default)."""
        kind = command if kind is None else kind
        self._answers.clear()
        self._command(command + b"\r")
        deadline_s = monotonic() + ANSWER_TIMEOUT_S
        answers = self._answers
        while kind not in answers and answers.get(b"") != _REFUSAL:
            left_s = deadline_s - monotonic()
            if left_s <= 0.0 or not self._exchange(left_s):
                break
            if not kind and self._frames:  # a silent adapter's channel is open
                break
        return answers.get(kind)

    def _ask_text(self, command: bytes) -> str | None:
        answer = self._ask(command)
        return answer[1:].decode("ascii", "replace") if answer is not None else None

    def _command(self, line: bytes) -> None:
        self._pending += line
        self._flush()
