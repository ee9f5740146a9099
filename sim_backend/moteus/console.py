"""The diagnostic console of the emulated controller: lines of text in, lines of text out.

Source: moteus documentation, "Diagnostic Protocol" (docs/protocol/diagnostic.md).
"""

from collections.abc import Callable

from sim_backend.moteus.controller import Command, Controller

INPUT_MAX = 128
"""Bytes of a line not yet ended that are kept."""
OUTPUT_MAX = 16 << 10


class ConsoleServer:
    """Obeys `conf get|set|enumerate|load|write`, `tel ...` and `d stop`; the rest is an error.

    Nothing is ever stored for good: `conf write` says OK and does nothing.
    """

    def __init__(self, controller: Controller) -> None:
        self._controller = controller
        self._line = b""
        self._out = b""
        self._groups: dict[str, Callable[[list[str]], str]] = {
            "conf": self._conf,
            "tel": lambda _: "OK",
            "d": self._debug,
        }

    def reset(self) -> None:
        """Forget what is half said."""
        self._line = self._out = b""

    def take(self, data: bytes) -> None:
        """Take bytes from the client and answer the lines that they end."""
        *lines, rest = (self._line + data).replace(b"\r", b"\n").split(b"\n")
        self._line = rest[-INPUT_MAX:]
        for line in lines:
            words = line.decode("latin-1").split()
            if words:
                answer = self._obey(words) + "\r\n"
                self._out = (self._out + answer.encode("latin-1"))[-OUTPUT_MAX:]

    def give(self, most: int) -> bytes:
        """Return up to so many bytes of what is to be said."""
        given, self._out = self._out[:most], self._out[most:]
        return given

    def _obey(self, words: list[str]) -> str:
        group = self._groups.get(words[0])
        return group(words[1:]) if group else "ERR unknown command"

    def _conf(self, words: list[str]) -> str:
        values = self._controller.configuration
        verb, *arguments = words or [""]
        if verb in ("load", "write", "default"):
            return "OK"
        if verb == "enumerate":
            return "\r\n".join([*(f"{k} {v:.9g}" for k, v in values.items()), "OK"])
        if not arguments or arguments[0] not in values:
            return "ERR error reading" if verb == "get" else "ERR error setting"
        if verb == "get":
            return f"{values[arguments[0]]:.9g}"
        return self._set(arguments) if verb == "set" else "ERR unknown subcommand"

    def _set(self, arguments: list[str]) -> str:
        try:
            self._controller.configuration[arguments[0]] = float(arguments[1])
        except (IndexError, ValueError):
            return "ERR error setting"
        return "OK"

    def _debug(self, words: list[str]) -> str:
        if words[:1] == ["stop"]:
            self._controller.obey(Command())
            return "OK"
        return "ERR unknown command"
