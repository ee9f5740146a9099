"""The emulated robot on the wire model in virtual time: no clock, the same bytes every time."""

from collections.abc import Callable, Sequence

from sim_backend.can_controller import CanController
from sim_backend.chain import CURRENT_LOOP_PERIOD_NS
from sim_backend.emulator import Emulator
from sim_backend.node import AmplifierNode
from sim_backend.settings import WireSettings
from sim_backend.wire import WireModel


class WiredNode(AmplifierNode):
    """An amplifier behind a CAN controller of its own: deaf while that is bus-off.

    Attributes:
        node: The amplifier.
    """

    def __init__(self, node: AmplifierNode, controller: CanController) -> None:
        super().__init__(node.servo, _lose)
        self.takes_fd = node.takes_fd
        self.takes_remote_requests = node.takes_remote_requests
        self.node = node
        self.takes_fd = node.takes_fd
        self.takes_remote_requests = node.takes_remote_requests
        self._controller = controller
        self._receive = node.receive

    def power_on(self) -> None:
        """See `AmplifierNode.power_on`."""
        self.node.power_on()

    def receive(self, can_id: int, data: bytes) -> None:
        """Take one frame, if the controller is on the bus."""
        if not self._controller.is_bus_off:
            self._receive(can_id, data)

    def fail_power_stage(self) -> None:
        """See `AmplifierNode.fail_power_stage`."""
        self.node.fail_power_stage()

    def tick(self, dt_s: float) -> None:
        """See `AmplifierNode.tick`."""
        self.node.tick(dt_s)

    def begin_period(self) -> None:
        """See `AmplifierNode.begin_period`."""
        self.node.begin_period()


class Port:
    """Where an amplifier is plugged into the wire."""

    def __init__(self, model: WireModel, controller: CanController) -> None:
        self.controller = controller
        self._model = model

    def send(self, frame: bytes) -> None:
        """Put a frame of the amplifier on the wire now."""
        self._model.send(self.controller, frame)

    def attach(self, node: AmplifierNode) -> WiredNode:
        """Plug the amplifier in."""
        return WiredNode(node, self.controller)


class VirtualWire:
    """A host and the emulated amplifiers on one wire; frames and plant share virtual time.

    The plant runs by this time as it would by the clock: its current loops start at multiples of
    500 us, and a SYNC acts when it has arrived. Amplifiers do not hear each other.

    Args:
        settings: The wire.
        to_host: Takes frames that have arrived at the host, and its controller's reports.
        joints: Number of amplifiers.
        bit_rate: Of the bus, and of the first phase of FD frames.
        data_bit_rate: Of the second phase.

    Attributes:
        model: The wire itself.
        host: The host's controller.
        ports: One per amplifier, shoulder first.
    """

    def __init__(
        self,
        settings: WireSettings,
        to_host: Callable[[bytes], None],
        *,
        joints: int,
        bit_rate: int,
        data_bit_rate: int,
    ) -> None:
        self.model = WireModel(
            settings, self._deliver, bit_rate=bit_rate, data_bit_rate=data_bit_rate
        )
        self._to_host = to_host
        self.host = self.model.join("host", self._to_host_now)
        self.ports: Sequence[Port] = [
            Port(self.model, self.model.join(f"joint {joint}")) for joint in range(1, joints + 1)
        ]
        self._emulator: Emulator | None = None
        self._tick_ns = CURRENT_LOOP_PERIOD_NS
        self._has_arrived = False

    def connect(self, emulator: Emulator) -> None:
        """Put the emulated robot at the other end; it must run by the clock, not in lockstep."""
        self._emulator = emulator

    def send(self, frame: bytes) -> None:
        """Put a frame of the host on the wire now."""
        self.model.send(self.host, frame)

    def advance(self, until_ns: int, *, stops_at_host: bool = False) -> int:
        """Let time pass.

        Args:
            until_ns: Virtual time to reach.
            stops_at_host: Return as soon as something has arrived at the host.

        Returns:
            The virtual time reached.

        Raises:
            PlantError: If the arm broke down.
        """
        step, emulator = self.model.step, self._emulator
        self._has_arrived = False
        while True:
            tick_ns = self._tick_ns
            limit_ns = min(tick_ns, until_ns)
            while step(limit_ns):
                if self._has_arrived and stops_at_host:
                    return self.model.now_ns
            if tick_ns > until_ns:
                return until_ns
            self._tick_ns += CURRENT_LOOP_PERIOD_NS
            if emulator is not None:
                emulator.advance(CURRENT_LOOP_PERIOD_NS)

    def _deliver(self, frame: bytes, sender: CanController) -> None:
        if sender is not self.host:
            if not self.host.is_bus_off:
                self._to_host_now(frame)
        elif self._emulator is not None:
            self._emulator.receive(frame)

    def _to_host_now(self, frame: bytes) -> None:
        self._has_arrived = True
        self._to_host(frame)


def _lose(_frame: bytes) -> None:
    """The amplifier itself transmits, not what stands around it."""
