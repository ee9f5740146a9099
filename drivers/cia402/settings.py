"""Settings of a CiA 402 amplifier. Scales are configuration and are checked against the drive."""

from typing import Any, Literal

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

    @classmethod
    def defaults(cls, joint: int, tau_max_Nm: float) -> dict[str, Any]:
        """See `AxisSettings.defaults`: rated for a third of the motor's largest torque."""
        return {
            "family": "cia402",
            "node_id": joint,
            "rated_torque_Nm": round(tau_max_Nm / 3.0, 3),
            "torque_max_Nm": tau_max_Nm,
        }

    @property
    def node(self) -> int:
        """CANopen node id."""
        return self.node_id

    @property
    def master_heartbeat_ms(self) -> int:
        """The master's heartbeat is as frequent as the drive's."""
        return self.heartbeat_ms
