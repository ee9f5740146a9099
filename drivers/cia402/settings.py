"""Settings of a CiA 402 amplifier. Scales are configuration and are checked against the drive."""

from typing import Any, Literal

from pydantic import Field

from drivers.cia402 import codec
from drivers.settings import ACYCLIC, AxisSettings, CycleFrame


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
    def watchdog_s(self) -> float:
        """The RPDO's deadline (1400:05)."""
        return self.rpdo_timeout_ms * 1e-3

    @property
    def master_heartbeat_ms(self) -> int:
        """The master's heartbeat is as frequent as the drive's."""
        return self.heartbeat_ms

    def identifiers(self) -> dict[int, str]:
        """The predefined connection set in use (CiA 301, 7.3.5)."""
        own = {codec.COB_EMCY: "EMCY", codec.COB_TPDO1: "TPDO1", codec.COB_RPDO1: "RPDO1",
               codec.COB_SDO_TX: "SDO", codec.COB_SDO_RX: "SDO",
               codec.COB_HEARTBEAT: "heartbeat"}  # fmt: skip
        common = {codec.COB_NMT: "NMT", codec.COB_SYNC: "SYNC"}
        return common | {cob_id + self.node_id: use for cob_id, use in own.items()}

    def cycle_frames(self, period_s: float) -> tuple[CycleFrame, ...]:
        """SYNC, RPDO1 and TPDO1; now and then a heartbeat each way, EMCY, one SDO frame."""
        beat = max(2, round(self.heartbeat_ms * 1e-3 / period_s))
        return (
            CycleFrame("SYNC", 0, is_shared=True),
            CycleFrame("RPDO1", 4),
            CycleFrame("TPDO1", 8),
            CycleFrame("heartbeat", 1, every=beat),
            CycleFrame("EMCY", 8, every=ACYCLIC),
            CycleFrame("master heartbeat", 1, every=beat, is_shared=True),
            CycleFrame("SDO", 8, every=ACYCLIC, is_shared=True),
        )
