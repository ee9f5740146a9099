"""A bus that can tell how long its user has waited for frames."""

import select
from time import perf_counter_ns

from drivers.bus import Bus


class WaitTimer(Bus):
    """Another bus, with the waiting in `recv` done and timed out here if so wished.

    Untimed, `send` and `recv` are the other bus's own methods, without any detour. Timed, a
    `recv` that may wait first waits for the descriptor, asleep or by looking again and again, so
    that the other bus finds its frame.

    Attributes:
        waited_ns: Time waited; set it to 0 where counting is to begin.
    """

    def __init__(self, bus: Bus, *, is_spinning: bool = False) -> None:
        super().__init__()
        self.stats = bus.stats
        self.waited_ns = 0
        self._bus = bus
        self._readable = (bus.fileno(),)
        self._is_spinning = is_spinning
        self.set_timed(False)

    def set_timed(self, is_timed: bool) -> None:
        self.__dict__["send"] = self._bus.send
        self.__dict__["recv"] = self._recv_timed if is_timed else self._bus.recv

    def _recv_timed(self, timeout_s: float) -> bytes | None:
        if timeout_s > 0.0:
            start_ns = perf_counter_ns()
            deadline_ns = start_ns + timeout_s * 1e9 if self._is_spinning else 0
            patience_s = 0.0 if self._is_spinning else timeout_s
            while not select.select(self._readable, (), (), patience_s)[0]:
                if perf_counter_ns() > deadline_ns:
                    break
            self.waited_ns += perf_counter_ns() - start_ns
        return self._bus.recv(timeout_s)

    def send(self, frame: bytes) -> bool:
        return self._bus.send(frame)

    def recv(self, timeout_s: float) -> bytes | None:
        return self._bus.recv(timeout_s)

    def fileno(self) -> int:
        return self._bus.fileno()

    def close(self) -> None:
        self._bus.close()
