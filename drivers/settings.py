"""Settings that every amplifier family has."""

from abc import ABC, abstractmethod
from typing import Any, Literal, NamedTuple

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    model_serializer,
)

MOST_BUSES = 4
"""So many buses one arm can have."""
ACYCLIC = 100
"""`CycleFrame.every` of what comes now and then: at most one in so many cycles."""


class CycleFrame(NamedTuple):
    """A kind of frame that an amplifier in operation, or its master, puts on the bus."""

    name: str
    """In the family's own words."""
    length: int
    """Data bytes, at most. CAN FD: a length that exists (8, 12, 16, 20, 24, 32, 48, 64)."""
    is_extended: bool = False
    """29-bit identifier."""
    is_fd: bool = False
    """CAN FD, data at the bus's second bit rate."""
    every: int = 1
    """At most one in so many cycles; 1 = in every cycle."""
    is_shared: bool = False
    """Once per bus: axes that name the same frame share it (SYNC, the master's heartbeat)."""


class AxisSettings(BaseModel, ABC):
    """One amplifier and how its shaft sits on the joint. A family adds its own `family` name."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    direction: Literal[1, -1] = Field(
        1, description="+1 if the amplifier counts up and pushes along the joint's +z axis"
    )
    offset_rad: float = Field(0.0, description="joint angle at encoder count zero")
    bus: int = Field(
        1, ge=1, le=MOST_BUSES, description="1 is `bus.address`, 2 the first of `bus.more`"
    )

    @model_serializer(mode="wrap")
    def _leave_out_first_bus(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A configuration of one bus reads as it did when there were no others."""
        table: dict[str, Any] = dump(self)
        if self.bus == 1:
            table.pop("bus", None)
        return table

    @classmethod
    @abstractmethod
    def defaults(cls, joint: int, tau_max_Nm: float) -> dict[str, Any]:
        """Return the settings without a default of their own, for an emulated motor.

        Args:
            joint: 1 = shoulder; becomes the node's number on the bus.
            tau_max_Nm: The motor's largest torque.
        """

    @property
    @abstractmethod
    def node(self) -> int:
        """The amplifier's number on its bus, unique among the axes of its family there."""

    @property
    def watchdog_s(self) -> float | None:
        """After so long without a command the amplifier takes torque off by itself.

        None: nothing in the protocol makes it do so, or nothing over the bus can tell whether it
        does. Torque may then stay on when the master dies.
        """
        return None

    @property
    def master_heartbeat_ms(self) -> int:
        """The longest silence of the master's CANopen heartbeat; 0 = the family knows none."""
        return 0

    def identifiers(self) -> dict[int, str]:
        """Return the 11-bit identifiers used with this axis, both directions, and what for.

        Axes that name the same use of an identifier share it. Empty: the family does not say.
        """
        return {}

    def cycle_frames(self, period_s: float) -> tuple[CycleFrame, ...]:
        """Return every kind of frame on the bus because of this axis, in both directions.

        Args:
            period_s: The control period.
        """
        raise NotImplementedError(f"{type(self).__name__} does not say what it puts on the bus")
