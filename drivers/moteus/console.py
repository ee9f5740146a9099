"""The controller's diagnostic console, tunnelled through CAN FD frames: configuration as text.

Source: moteus documentation, "Diagnostic Protocol" (docs/protocol/diagnostic.md), `conf` and `tel`.
"""

from drivers.axis import Port
from drivers.errors import AmplifierError
from drivers.moteus import codec

LINE_MAX = 60
"""Characters of a command that fit into one frame."""
_POLLS = 100
_PAUSE_S = 1e-3
_ROOM = 48  # bytes of a reply asked for


class Console:
    """Reads and writes configuration values, in the controller's memory only (no `conf write`)."""

    def __init__(self, port: Port, ids: tuple[int, int], label: str, timeout_s: float) -> None:
        """Prepare to talk.

        Args:
            port: The bus, while waiting is allowed.
            ids: Identifiers of requests and of replies.
            label: How messages name the axis.
            timeout_s: Longest wait for one reply.
        """
        self._port = port
        self._request_id, self._reply_id = ids
        self._label = label
        self._timeout_s = timeout_s
        self._text = b""

    def start(self) -> None:
        """Silence periodic output that somebody has asked for, and forget what is left of it.

        Raises:
            AmplifierError: If the controller does not answer.
        """
        self._exchange(codec.pack_stream(codec.CLIENT_DATA, codec.CONSOLE_CHANNEL, b"tel stop\n"))
        for _ in range(_POLLS):
            self._port.wait(self._reply_id, _PAUSE_S)
            if not self._poll():
                break
        self._text = b""

    def get(self, name: str) -> float:
        """Return a configuration value.

        Raises:
            AmplifierError: If the controller does not answer, or knows no such value.
        """
        answer = self._command(f"conf get {name}")
        try:
            return float(answer)
        except ValueError:
            raise AmplifierError(
                f"{self._label}: `conf get {name}` answers {_printable(answer)}; "
                "update the controller's firmware"
            ) from None

    def set(self, name: str, value: float) -> None:
        """Change a configuration value and read it back.

        Raises:
            AmplifierError: If the controller refuses, or keeps another value.
        """
        answer = self._command(f"conf set {name} {value:.9g}")
        if answer != b"OK":
            raise AmplifierError(f"{self._label}: `conf set {name}` answers {_printable(answer)}")
        found = self.get(name)
        if abs(found - value) > 1e-6 * max(1.0, abs(value)):
            raise AmplifierError(
                f"{self._label}: {name} is {found:g} although it was set to {value:g}; "
                "set it with moteus_tool"
            )

    def _command(self, line: str) -> bytes:
        text = line.encode("ascii") + b"\n"
        self._text = b""
        self._take(
            self._exchange(codec.pack_stream(codec.CLIENT_DATA, codec.CONSOLE_CHANNEL, text))
        )
        for _ in range(_POLLS):
            answer = self._first_line()
            if answer:
                return answer
            if not self._poll():
                self._port.wait(self._reply_id, _PAUSE_S)
        raise AmplifierError(f"{self._label}: no answer to `{line}` on the diagnostic console")

    def _poll(self) -> bool:
        """Ask for more text; True if there was some."""
        poll = bytes((codec.CLIENT_POLL, codec.CONSOLE_CHANNEL, _ROOM))
        return self._take(self._exchange(poll))

    def _exchange(self, data: bytes) -> bytes:
        self._port.send(self._request_id, codec.pad(data), is_fd=True)
        reply = self._port.wait(self._reply_id, self._timeout_s)
        if reply is None:
            raise AmplifierError(f"{self._label}: the diagnostic console does not answer")
        return reply

    def _take(self, reply: bytes) -> bool:
        parts = codec.parse_subframes(reply)[0]
        text = b"".join(part.data for part in parts if part.kind == codec.SERVER_DATA)
        self._text += text
        return bool(text)

    def _first_line(self) -> bytes:
        """Return the first whole line that is not empty, else nothing."""
        for line in self._text.replace(b"\r", b"\n").split(b"\n")[:-1]:
            if line.strip():
                return line.strip()
        return b""


def _printable(text: bytes) -> str:
    return repr(text.decode("ascii", "replace"))
