"""Settings of a MIT-mode motor. The codes' ranges are configuration; Damiao's are checked."""

from typing import Any, Literal, Self

from pydantic import Field, model_validator

from drivers.mit import codec
from drivers.mit.codec import POSITION_CODES, SHORT_CODES, Ranges
from drivers.mit.robstride_codec import FACTORY_HOST
from drivers.settings import ACYCLIC, AxisSettings, CycleFrame

Variant = Literal["damiao", "tmotor", "cubemars", "cybergear", "robstride"]
_WIDE = ("cybergear", "robstride")  # 29-bit identifiers, 16-bit numbers
_SILENT_ABOUT_WATCHDOG = ("tmotor", "cubemars", "cybergear")


class MitSettings(AxisSettings):
    """One motor with MIT-mode control; angle, rate and torque are those of its output shaft."""

    family: Literal["mit"] = "mit"
    variant: Variant = "damiao"
    node_id: int = Field(ge=1, le=127, description="CAN id that the motor listens to")
    master_id: int | None = Field(
        None,
        ge=0,
        le=0x7FE,
        description="CAN id that it answers with (29-bit variants: the host's); left out: damiao "
        "node_id + 16, tmotor 0, cubemars node_id, else 253",
    )
    position_range_rad: float = Field(12.5, gt=0, description="PMAX: codes span +- this")
    velocity_range_rad_s: float = Field(30.0, gt=0, description="VMAX: codes span +- this")
    torque_range_Nm: float = Field(gt=0, description="TMAX: codes span +- this")
    kp_range_Nm_rad: float = Field(500.0, gt=0, description="codes span 0 to this; never used")
    kd_range_Nms_rad: float = Field(5.0, gt=0, description="codes span 0 to this; never used")
    torque_max_Nm: float = Field(gt=0, description="never sent more than this")
    watchdog_ms: int = Field(
        20,
        ge=2,
        le=1000,
        description="the motor drops torque after this long without a command; set and verified "
        "for damiao and robstride, for the others what it was set to with the vendor's tool",
    )
    silence_ms: int = Field(20, ge=2, le=1000, description="without an answer for this: lost")
    reply_timeout_s: float = Field(0.1, gt=0, description="at start-up")
    is_lockstep: bool = Field(
        False, description="tmotor and cubemars cannot tell: emulated, time follows the cycle"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.torque_max_Nm > self.torque_range_Nm:
            raise ValueError(
                f"torque_max_Nm = {self.torque_max_Nm:g} is above torque_range_Nm = "
                f"{self.torque_range_Nm:g}, the most that the motor's codes can say"
            )
        if self.torque_max_Nm < self.torque_resolution_Nm:
            raise ValueError(
                f"torque_max_Nm = {self.torque_max_Nm:g} is below {self.torque_resolution_Nm:.3g}, "
                "the step of the motor's torque codes"
            )
        if self.is_wide and self.reply_id > 0xFF:
            raise ValueError(f"master_id = {self.reply_id} is above 255, the most {self.variant}"
                             " can address")  # fmt: skip
        if self.variant == "damiao" and self.node_id > 15:
            raise ValueError(
                f"node_id = {self.node_id} is above 15: a Damiao reply names only four bits of it"
            )
        if self.variant in ("damiao", "tmotor") and self.reply_id == self.node_id:
            raise ValueError(
                f"master_id = {self.reply_id} is the motor's own node_id; give it another"
            )
        return self

    @classmethod
    def defaults(cls, joint: int, tau_max_Nm: float) -> dict[str, Any]:
        """See `AxisSettings.defaults`: codes that span just the motor's torque."""
        return {
            "family": "mit",
            "node_id": joint,
            "torque_range_Nm": tau_max_Nm,
            "torque_max_Nm": tau_max_Nm,
        }

    @property
    def node(self) -> int:
        """CAN id of the motor."""
        return self.node_id

    @property
    def is_wide(self) -> bool:
        """29-bit identifiers and 16-bit numbers."""
        return self.variant in _WIDE

    @property
    def reply_id(self) -> int:
        """`master_id`, or what the variant uses."""
        if self.master_id is not None:
            return self.master_id
        if self.is_wide:
            return FACTORY_HOST
        return {"damiao": self.node_id + 16, "cubemars": self.node_id}.get(self.variant, 0)

    def identifiers(self) -> dict[int, str]:
        """The motor's own, and where it answers; of 29 bits none, they name motor and host."""
        if self.is_wide:
            return {}
        used = {self.reply_id: "MIT replies", self.node_id: "MIT command"}
        return used | ({codec.REGISTER_ID: "Damiao registers"} if self.variant == "damiao" else {})

    @property
    def ranges(self) -> Ranges:
        """What the codes span."""
        return Ranges(
            self.position_range_rad,
            self.velocity_range_rad_s,
            self.torque_range_Nm,
            self.kp_range_Nm_rad,
            self.kd_range_Nms_rad,
        )

    @property
    def torque_codes(self) -> int:
        """The largest torque code."""
        return POSITION_CODES if self.is_wide else SHORT_CODES

    @property
    def torque_resolution_Nm(self) -> float:
        """Torque between two codes; a torque of zero is sent as half of this, negative."""
        return 2.0 * self.torque_range_Nm / self.torque_codes

    @property
    def angle_resolution_rad(self) -> float:
        """Angle between two codes."""
        return 2.0 * self.position_range_rad / POSITION_CODES

    @property
    def has_settable_watchdog(self) -> bool:
        """The command watchdog can be set, and read back, over the bus."""
        return self.variant not in _SILENT_ABOUT_WATCHDOG

    @property
    def watchdog_s(self) -> float | None:
        """Set and read back for damiao and robstride; None for those that do not tell."""
        return self.watchdog_ms * 1e-3 if self.has_settable_watchdog else None

    def cycle_frames(self, period_s: float) -> tuple[CycleFrame, ...]:
        """A command and its reply in every cycle; a stop beside them now and then."""
        del period_s
        wide = self.is_wide
        reply_bytes = 6 if self.variant == "tmotor" else 8
        frames = (
            CycleFrame("command", 8, is_extended=wide),
            CycleFrame("reply", reply_bytes, is_extended=wide),
            CycleFrame("stop", 8, is_extended=wide, every=ACYCLIC),
            CycleFrame("reply to stop", reply_bytes, is_extended=wide, every=ACYCLIC),
        )
        report = CycleFrame("fault report", 8, is_extended=True, every=ACYCLIC)
        return (*frames, report) if wide else frames
