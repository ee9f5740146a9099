"""Several buses as one wire: the emulated robot behind an arm whose amplifiers share no bus."""

import select
from collections import deque
from collections.abc import Sequence
from time import monotonic

from sim_backend.errors import SimError
from sim_backend.hub import Wire


class WireGroup(Wire):
    """Waits on all wires at once, and takes turns among those on which something has come.

    What is sent goes on one of `wires`; each amplifier has been given its own.

    Attributes:
        wires: In the order of the buses' numbers.
        bus: The bus (from 0) on which the frames that `wait` returned last have come.
    """

    def __init__(self, wires: Sequence[Wire], addresses: Sequence[str]) -> None:
        """Join open wires; they are closed together with this one.

        Args:
            wires: Each must have descriptors to wait for (`Wire.filenos`).
            addresses: Of the wires, for messages.

        Raises:
            SimError: If one has none.
        """
        self.wires = tuple(wires)
        self.address = ", ".join(
            wire.address or address for wire, address in zip(wires, addresses, strict=True)
        )
        for wire, address in zip(wires, addresses, strict=True):
            if not wire.filenos():
                raise SimError(
                    f"{address} cannot be emulated as one of several buses: there is nothing to "
                    "wait for; use unix:PATH or a SocketCAN interface"
                )
        self._busy: deque[int] = deque()

    def transmit(self, frame: bytes) -> None:
        """Put one record on every wire; see `Wire.transmit`."""
        for wire in self.wires:
            wire.transmit(frame)

    def filenos(self) -> Sequence[int]:
        """See `Wire.filenos`."""
        return [fd for wire in self.wires for fd in wire.filenos()]

    def wait(self, timeout_s: float) -> list[bytes]:
        """Return frames of one bus, and say in `bus` of which; see `Wire.wait`."""
        deadline_s = monotonic() + timeout_s
        while True:
            frames = self._take()
            if frames or (timeout_s < 0.0 and not self._busy):
                return frames
            self._look(max(0.0, timeout_s))
            timeout_s = deadline_s - monotonic() if self._busy else -1.0

    def _take(self) -> list[bytes]:
        """Ask the wires that have had something to read, each until it has no more."""
        busy = self._busy
        while busy:
            bus = busy.popleft()
            frames = self.wires[bus].wait(0.0)
            if frames:
                busy.append(bus)
                self.bus = bus
                return frames
        return []

    def _look(self, timeout_s: float) -> None:
        bus_of = {fd: bus for bus, wire in enumerate(self.wires) for fd in wire.filenos()}
        try:
            ready = select.select(list(bus_of), (), (), timeout_s)[0]
        except ValueError as error:
            raise SimError(f"one of the buses {self.address} is closed") from error
        self._busy.extend(dict.fromkeys(bus_of[fd] for fd in ready))

    def close(self) -> None:
        """Leave every wire."""
        for wire in self.wires:
            wire.close()
