"""What every emulated amplifier is to the emulator: something on the wire in front of a servo."""

from abc import ABC, abstractmethod
from collections.abc import Callable

from sim_backend.servo import Servo

Transmit = Callable[[bytes], None]
"""Puts one frame record (`drivers.frame`) on the wire."""


class AmplifierNode(ABC):
    """An emulated amplifier: protocol state machine between the wire and one `Servo`.

    Attributes:
        takes_fd: CAN FD frames are for it too; the others do not see them.
        takes_remote_requests: The same of remote requests; their identifier has `RTR_FLAG`.
    """

    takes_fd = False
    takes_remote_requests = False

    def __init__(self, servo: Servo, transmit: Transmit) -> None:
        self.servo = servo
        self._transmit = transmit

    @abstractmethod
    def power_on(self) -> None:
        """Announce the node as it does after power-up."""

    @abstractmethod
    def receive(self, can_id: int, data: bytes) -> None:
        """Take one data frame from the wire. Never raises, whatever the bytes.

        Args:
            can_id: Identifier with flags (`drivers.frame`).
            data: 0 to 8 bytes, to 64 if it takes CAN FD.
        """

    @abstractmethod
    def tick(self, dt_s: float) -> None:
        """Advance the node's timers (heartbeat, watchdogs) by `dt_s` of emulated time."""

    def fail_power_stage(self) -> None:
        """Take torque off for a fault of the amplifier's own, and report it as the family does."""
        self.servo.is_energised = False

    def begin_period(self) -> None:  # noqa: B027 - most families answer SYNC instead
        """Send the cyclic messages that are due now.

        Called once per period of 1 ms: in lockstep when the master's SYNC or lockstep frame
        arrives, before time advances; by the clock after `tick`.
        """
