"""Error bookkeeping and EMCY messages of the emulated drive (CiA 301, 7.2.7 and 7.5.2.2-4)."""

from collections import deque
from collections.abc import Callable

from drivers.cia402.codec import EmcyCode, pack_emcy

HISTORY_LENGTH = 8
_GENERIC, _COMMUNICATION, _MANUFACTURER = 0x01, 0x10, 0x80


def error_register_bits(code: int) -> int:
    """Bits of the error register (1001) that an error code sets: 8xxx is communication."""
    return _GENERIC | (_COMMUNICATION if code >> 12 == 0x8 else _MANUFACTURER)


class Emergency:
    """The drive's active errors; says each once when it appears, and when the last is gone.

    Attributes:
        error_register: 1001, the union over the active errors.
        error_code: 603F, the last error that is still active, 0 if none is.
        history: 1003, error codes with the newest first.
    """

    __slots__ = ("_active", "_send", "error_code", "error_register", "history")

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self._send = send
        self._active: list[int] = []
        self.error_register = 0
        self.error_code = 0
        self.history: deque[int] = deque(maxlen=HISTORY_LENGTH)

    def raise_error(self, code: int) -> None:
        """Report an error, unless it is active already."""
        if code in self._active:
            return
        self._active.append(code)
        self.history.appendleft(code)
        self._update()
        self._send(pack_emcy(code, self.error_register))

    def clear(self, code: int) -> None:
        """Take back one error; the last one gone is reported as error reset."""
        if code in self._active:
            self._active.remove(code)
            self._update()
            if not self._active:
                self._send(pack_emcy(EmcyCode.ERROR_RESET, 0))

    def clear_all(self) -> None:
        """Take back every error, as a fault reset does."""
        for code in tuple(self._active):
            self.clear(code)

    def forget(self) -> None:
        """Drop errors and history without a message, as power-on does."""
        self._active.clear()
        self.history.clear()
        self._update()

    def _update(self) -> None:
        self.error_code = self._active[-1] if self._active else 0
        self.error_register = 0
        for code in self._active:
            self.error_register |= error_register_bits(code)
