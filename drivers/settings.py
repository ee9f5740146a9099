"""Settings that every amplifier family has."""

from abc import ABC, abstractmethod
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field


class AxisSettings(BaseModel, ABC):
    """One amplifier and how its shaft sits on the joint. A family adds its own `family` name."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    direction: Literal[1, -1] = Field(
        1, description="+1 if the amplifier counts up and pushes along the joint's +z axis"
    )
    offset_rad: float = Field(0.0, description="joint angle at encoder count zero")

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
        """The amplifier's number on the bus, unique among the axes of its family."""

    @property
    def master_heartbeat_ms(self) -> int:
        """The longest silence of the master's CANopen heartbeat; 0 = the family knows none."""
        return 0
