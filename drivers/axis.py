"""What every amplifier family offers to the loop: one `Axis` per joint."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol


class AxisStatus(IntEnum):
    """What an amplifier says of itself."""

    DISABLED = 0
    """Answers; no torque."""
    ENABLED = 1
    """Applies the torque it is sent."""
    FAULT = 2
    """Reports a fault; no torque until it is reset."""
    LOST = 3
    """Its heartbeat is missing, or it restarted by itself."""


@dataclass(frozen=True, slots=True)
class AxisInfo:
    """What an amplifier told about itself at start-up."""

    name: str
    torque_resolution_Nm: float
    angle_resolution_rad: float
    is_lockstep: bool
    """Emulated, and its time advances by one period per SYNC instead of by the clock."""
    is_emulated: bool = False
    """It said that it is emulated: faults may be asked for (`drivers.fault_frame`)."""


class Port(Protocol):
    """The bus as an axis sees it during start-up, when waiting is allowed."""

    def send(self, can_id: int, data: bytes, *, is_fd: bool = False) -> None:
        """Put a frame on the bus.

        Args:
            can_id: Identifier with flags (`drivers.frame`).
            data: 0 to 8 bytes; of CAN FD as many as `drivers.frame.FD_LENGTHS` allows.
            is_fd: A CAN FD frame, its data at the second bit rate.

        Raises:
            BusError: If the bus is gone, its queue stays full, or it carries no CAN FD.
        """

    def wait(self, can_id: int, timeout_s: float) -> bytes | None:
        """Return the data of the next frame with this identifier, None when the time is up."""


FrameHandler = Callable[[bytes], bool]
"""Takes one frame record; True if it was this cycle's feedback of the axis. Never raises."""


class Axis(ABC):
    """One joint's amplifier, master side.

    Attributes:
        label: How messages name the axis, e.g. `joint 1 (cia402 node 1)`.
        q_rad: Joint angle of the last fresh feedback.
        dq_rad_s: Joint rate the amplifier reported with it; None if the family reports none.
        tau_meas_Nm: Joint torque the amplifier reported with it.
        age_cycles: Cycles since that feedback; 0 = fresh. Between two cycles, -1 = it came since
            the last one, from an amplifier that sends by its own clock, and counts for the next.
        status: What the amplifier says of itself.
        note: One line about the last fault or emergency message, empty if there was none.
        uses_sync: The family needs a CANopen SYNC at the start of each cycle.
    """

    uses_sync = False

    def __init__(self, label: str) -> None:
        self.label = label
        self.q_rad = 0.0
        self.dq_rad_s: float | None = None
        self.tau_meas_Nm = 0.0
        self.age_cycles = 1
        self.status = AxisStatus.DISABLED
        self.note = ""

    @abstractmethod
    def configure(self, port: Port) -> AxisInfo:
        """Set the amplifier up for cyclic torque, disabled, and check its scales.

        Raises:
            AmplifierError: If it does not answer, refuses a setting, contradicts the
                configuration or is already enabled. No torque has been commanded.
        """

    @abstractmethod
    def start(self, port: Port) -> None:
        """Begin cyclic operation, once all axes of the arm are configured; still disabled."""

    @abstractmethod
    def handlers(self) -> dict[int, FrameHandler]:
        """Identifiers of the frames this axis takes in operation, each with its handler."""

    def shared_ids(self) -> frozenset[int]:
        """Identifiers on which other axes may be answered too: its handler knows its own frames."""
        return frozenset()

    @property
    def is_asked(self) -> bool:
        """Feedback is the answer to SYNC or to `request`; no family that is asked sends unasked."""
        return self.uses_sync or type(self).request is not Axis.request

    def request(self) -> bytes | None:
        """Return the frame that asks for feedback at the start of a cycle, None if none is needed.

        Families that answer a torque command with their state send the torque of the last
        `command` here, so that feedback belongs to the start of the cycle and torque acts one
        period after the feedback it was computed from, as with SYNC.
        """
        return None

    @abstractmethod
    def command(self, tau_Nm: float) -> bytes | None:
        """Return the frame to send in this cycle: torque if enabled, and power-state requests.

        None if the family has nothing to send at the end of a cycle (see `request`). What takes
        torque away is never put off to the next cycle.

        Args:
            tau_Nm: Joint torque, positive about the joint's axis, finite.
        """

    @abstractmethod
    def enable(self) -> None:
        """Ask for power; `status` becomes ENABLED some cycles later."""

    @abstractmethod
    def disable(self) -> None:
        """Ask for torque off, with the next command frame."""

    @abstractmethod
    def reset_fault(self) -> None:
        """Ask the amplifier to leave its fault state; it stays disabled."""

    def recount(self) -> None:  # noqa: B027 - families whose drives count turns have nothing to do
        """Forget turns that were counted from readings no joint can make; a reset calls it.

        The angle is then as at start-up, within half a turn of zero.
        """

    @abstractmethod
    def end_cycle(self) -> None:
        """Count this cycle in the axis's own watchdogs."""

    def inject_fault(self) -> bytes | None:
        """Return the frame that puts an *emulated* amplifier into fault, None if there is none."""
        return None
