"""Settings that every amplifier family has."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class AxisSettings(BaseModel):
    """One amplifier and how its shaft sits on the joint."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    direction: Literal[1, -1] = Field(
        1, description="+1 if the amplifier counts up and pushes along the joint's +z axis"
    )
    offset_rad: float = Field(0.0, description="joint angle at encoder count zero")
