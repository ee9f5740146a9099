"""Settings of a moteus controller. Position, velocity and torque are those of its output shaft."""

from typing import Any, Literal

from pydantic import Field

from drivers.moteus.codec import STATE_LENGTH, STOP, TORQUE_LENGTH, reply_id
from drivers.settings import ACYCLIC, AxisSettings, CycleFrame

_STANDARD_NODES = 7  # replies of node ids above need 29 bits: the node id stands in bits 8 to 14


class MoteusSettings(AxisSettings):
    """One moteus controller in position mode without gains: feed-forward torque alone."""

    family: Literal["moteus"] = "moteus"
    node_id: int = Field(ge=1, le=126, description="id.id")
    source_id: int = Field(0, ge=0, le=126, description="this host's number on the bus")
    can_prefix: int = Field(
        0, ge=0, le=0x1FFF, description="can.prefix; not 0 keeps clear of CANopen's identifiers"
    )
    torque_max_Nm: float = Field(
        gt=0, le=327.0, description="written into each command as its own limit (0x025)"
    )
    counts_per_turn: int | None = Field(
        None,
        ge=2,
        description="motor_position.sources.0.cpr; left out, what the controller says is taken",
    )
    watchdog_ms: int = Field(
        20, ge=2, le=1000, description="the controller takes torque off after so long (0x027)"
    )
    on_timeout: Literal["stop", "brake", "damp"] = Field(
        "stop",
        description="servo.timeout_mode: driver off, windings shorted, or damped under power",
    )
    lost_after_ms: int = Field(50, ge=2, le=1000, description="silence that counts as a loss")
    reply_timeout_s: float = Field(0.1, gt=0, description="during start-up")

    @classmethod
    def defaults(cls, joint: int, tau_max_Nm: float) -> dict[str, Any]:
        """See `AxisSettings.defaults`."""
        return {"family": "moteus", "node_id": joint, "torque_max_Nm": tau_max_Nm}

    @property
    def node(self) -> int:
        """The controller's id."""
        return self.node_id

    @property
    def watchdog_s(self) -> float:
        """The drive's own, set at start-up."""
        return self.watchdog_ms * 1e-3

    def identifiers(self) -> dict[int, str]:
        """Of 11 bits: what the controller obeys, of whatever length of identifier, and its reply.

        It takes classic frames too: an RPDO or SDO request to the CANopen node of its number would
        be read as a command. A prefix keeps all of its frames to 29 bits.
        """
        if self.can_prefix:
            return {}
        heard = {
            source << 8 | self.node_id: f"a command to moteus id {self.node_id}"
            for source in range(_STANDARD_NODES + 1)
        }
        reply = reply_id(self.node_id, self.source_id)
        return heard | ({reply: "reply"} if self.node_id <= _STANDARD_NODES else {})

    def cycle_frames(self, period_s: float) -> tuple[CycleFrame, ...]:
        """A torque command and its reply; now and then a stop, and its reply."""
        del period_s
        is_wide = self.can_prefix > 0 or self.node_id > _STANDARD_NODES
        return (
            CycleFrame("torque", TORQUE_LENGTH, is_extended=True, is_fd=True),
            CycleFrame("reply", STATE_LENGTH, is_extended=is_wide, is_fd=True),
            CycleFrame("stop", len(STOP), is_extended=True, is_fd=True, every=ACYCLIC),
            CycleFrame(
                "reply to stop", STATE_LENGTH, is_extended=is_wide, is_fd=True, every=ACYCLIC
            ),
        )
