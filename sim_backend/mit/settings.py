"""What can be set of an emulated MIT-mode motor."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

from drivers.mit.codec import Ranges

Variant = Literal["damiao", "tmotor", "cubemars", "cybergear", "robstride"]


class MitNodeSettings(BaseModel):
    """One emulated motor as it left its vendor's tool."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    variant: Variant = "damiao"
    node_id: int = Field(ge=1, le=127)
    reply_id: int = Field(ge=0, le=0x7FE, description="29-bit variants: the host's id")
    ranges: Ranges
    watchdog_ms: int = Field(
        0, ge=0, description="0 = off; damiao and robstride are always switched on with it off"
    )
    is_lockstep: bool = Field(
        False, description="what damiao, cybergear and robstride tell when asked who they are"
    )
