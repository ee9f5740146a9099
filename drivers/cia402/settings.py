"""Settings of a CiA 402 amplifier. Scales are configuration and are checked against the drive."""

from typing import Literal

from pydantic import Field

from drivers.settings import AxisSettings


class Cia402Settings(AxisSettings):
    """One CANopen drive in cyclic synchronous torque mode."""

    family: Literal["cia402"] = "cia402"
    node_id: int = Field(ge=1, le=126)
    rated_torque_Nm: float = Field(gt=0, description="6076; torque objects are per mille of it")
    counts_per_turn: int = Field(4096, ge=2, description="608F: position units per turn")
    torque_max_Nm: float = Field(gt=0, description="written to 6072, the drive's own torque limit")
    heartbeat_ms: int = Field(100, ge=10, le=1000, description="the drive's, and the master's")
    rpdo_timeout_ms: int = Field(
        20, ge=2, le=1000, description="the drive removes torque after this long without a command"
    )
    sdo_timeout_s: float = Field(0.5, gt=0)
