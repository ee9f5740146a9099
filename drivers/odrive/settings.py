"""Settings of an ODrive axis. Everything is at the joint's side of the gear."""

from typing import Any, Literal

from pydantic import Field

from drivers.odrive.codec import MAX_NODE, Command, can_id
from drivers.settings import ACYCLIC, AxisSettings, CycleFrame


class OdriveSettings(AxisSettings):
    """One ODrive axis, firmware 0.6 or newer, in torque control over CANSimple."""

    family: Literal["odrive"] = "odrive"
    node_id: int = Field(ge=0, le=MAX_NODE)
    gear_ratio: float = Field(1.0, gt=0, le=1000, description="motor turns per joint turn")
    torque_max_Nm: float = Field(gt=0, description="also the drive's own limit, torque_soft_max")
    velocity_max_rad_s: float = Field(
        30.0, gt=0, description="the drive's vel_limit: it faults beyond this and its tolerance"
    )
    feedback: Literal["poll", "cyclic"] = Field(
        "poll",
        description="poll: asked for at the start of each cycle; cyclic: sent by the drive's clock",
    )
    heartbeat_ms: int = Field(50, ge=2, le=1000, description="the drive's; faults come with it")
    torque_report_ms: int = Field(
        20, ge=0, le=1000, description="the drive's torque estimate, 0 = never"
    )
    watchdog_ms: int = Field(
        20, ge=2, le=1000, description="the drive removes torque after this long without a frame"
    )
    parameters: Literal["set", "preset"] = Field(
        "set", description="preset: limits, rates and watchdog were stored in the drive by hand"
    )
    endpoints_file: str | None = Field(
        None, description="the vendor's flat_endpoints.json for this firmware, to set parameters"
    )
    reply_timeout_s: float = Field(0.2, gt=0, le=5)

    @classmethod
    def defaults(cls, joint: int, tau_max_Nm: float) -> dict[str, Any]:
        """See `AxisSettings.defaults`."""
        return {"family": "odrive", "node_id": joint, "torque_max_Nm": tau_max_Nm}

    @property
    def node(self) -> int:
        """CANSimple node id."""
        return self.node_id

    @property
    def watchdog_s(self) -> float:
        """The drive's own, set at start-up."""
        return self.watchdog_ms * 1e-3

    def identifiers(self) -> dict[int, str]:
        """All 32 commands of the node: two axes in one block would answer each other."""
        names = {int(command): f"0x{command:02X}" for command in Command}
        return {
            can_id(self.node_id, command): f"command {names.get(command, 'unused')}"
            for command in range(32)
        }

    def cycle_frames(self, period_s: float) -> tuple[CycleFrame, ...]:
        """Torque and encoder in each cycle; now and then heartbeat, torques, errors, a service."""
        frames = [CycleFrame("torque 0x0E", 4), CycleFrame("encoder 0x09", 8)]
        if self.feedback == "poll":
            frames.append(CycleFrame("poll 0x09", 0))
        frames.append(CycleFrame("heartbeat 0x01", 8, every=_cycles(self.heartbeat_ms, period_s)))
        if self.torque_report_ms:
            every = _cycles(self.torque_report_ms, period_s)
            frames.append(CycleFrame("torques 0x1C", 8, every=every))
        frames.append(CycleFrame("error 0x03", 8, every=ACYCLIC))
        frames.append(CycleFrame("service 0x04, 0x05", 8, every=ACYCLIC))
        return tuple(frames)


def _cycles(interval_ms: int, period_s: float) -> int:
    return max(2, round(interval_ms * 1e-3 / period_s))
