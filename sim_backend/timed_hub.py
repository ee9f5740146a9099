"""The Unix bus with the wire model in it: frames arrive when a real bus would have let them."""

import select
from collections.abc import Sequence
from time import monotonic_ns

from sim_backend.can_controller import CanController
from sim_backend.errors import SimError
from sim_backend.hub import UnixHub, _Client
from sim_backend.settings import WireSettings
from sim_backend.wire import WireModel
from sim_backend.wired import Port


class TimedHub(UnixHub):
    """The hub by the clock: every client and every amplifier has a CAN controller of its own.

    An amplifier's answer counts as sent at the instant at which the question arrived; a client's
    frame when it is read. A client whose controller is bus-off neither sends nor receives; the
    reports of its controller reach it as frames with `ERR_FLAG`. Amplifiers do not hear each
    other.

    Attributes:
        model: The wire.
    """

    def __init__(
        self, path: str, settings: WireSettings, *, bit_rate: int, data_bit_rate: int
    ) -> None:
        super().__init__(path)
        self.model = WireModel(
            settings, self._deliver, bit_rate=bit_rate, data_bit_rate=data_bit_rate
        )
        self._own = self.model.join("emulator")
        self._emulated = {self._own}
        self._controllers: dict[_Client, CanController] = {}
        self._senders: dict[CanController, _Client] = {}
        self._arrived: list[bytes] = []
        self._opened_ns = monotonic_ns()

    def ports(self, joints: int) -> Sequence[Port]:
        """Plug in one controller per amplifier, shoulder first."""
        names = [f"joint {joint}" for joint in range(1, joints + 1)]
        ports = [Port(self.model, self.model.join(name)) for name in names]
        self._emulated.update(port.controller for port in ports)
        return ports

    def controller_of(self, client: int) -> CanController:
        """Return the controller of a client, by its place in `clients`."""
        return list(self._controllers.values())[client]

    def transmit(self, frame: bytes) -> None:
        """Send a frame of the emulator itself, not of one of its amplifiers."""
        self.model.send(self._own, frame)

    def wait(self, timeout_s: float) -> list[bytes]:
        """Return the next frame that has arrived at the amplifiers; see `Wire.wait`."""
        deadline_ns = self._now_ns() + max(0, round(timeout_s * 1e9))
        while True:
            now_ns = self._now_ns()
            while not self._arrived and self.model.step(now_ns):
                pass
            if self._arrived:  # let them answer before anything else happens
                return self._take_arrived()
            self._listen_until(deadline_ns, now_ns)
            if now_ns >= deadline_ns:
                return self._take_arrived()

    def _listen_until(self, deadline_ns: int, now_ns: int) -> None:
        """Wait for clients until a frame arrives or the time is up; queue what they send."""
        next_ns = self.model.next_ns
        until_ns = deadline_ns if next_ns is None else min(deadline_ns, next_ns)
        try:
            ready = select.select(self._readable, (), (), max(0, until_ns - now_ns) * 1e-9)[0]
        except ValueError as error:
            raise SimError(f"the bus at unix:{self.path} is closed") from error
        if not ready:
            return
        now_ns = self._now_ns()
        while self.model.step(now_ns):
            if self._arrived:  # clients are read when it has been answered
                return
        self._collect(ready)

    def _take_arrived(self) -> list[bytes]:
        frames, self._arrived = self._arrived, []
        return frames

    def _now_ns(self) -> int:
        return monotonic_ns() - self._opened_ns

    def _deliver(self, frame: bytes, sender: CanController) -> None:
        for controller, client in self._senders.items():
            if controller is not sender and not controller.is_bus_off:
                client.put(frame)
        if sender not in self._emulated:
            self._arrived.append(frame)

    def _relay(self, frame: bytes, sender: _Client) -> bool:
        """Queue a client's frame; it reaches nobody yet."""
        self.model.send(self._controllers[sender], frame)
        return False

    def _has_joined(self, client: _Client) -> None:
        controller = self.model.join("client", client.put)
        self._controllers[client] = controller
        self._senders[controller] = client

    def _has_left(self, client: _Client) -> None:
        controller = self._controllers.pop(client)
        del self._senders[controller]
        self.model.leave(controller)
