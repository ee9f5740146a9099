"""What can be set of the emulated arm and its amplifiers."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class LinkSettings(_Settings):
    """One rigid link and the friction of the joint that carries it."""

    length_m: float = Field(gt=0)
    com_m: float = Field(gt=0, description="joint to centre of mass")
    mass_kg: float = Field(gt=0)
    inertia_kg_m2: float = Field(gt=0, description="about the centre of mass")
    viscous_Nms_rad: float = Field(0.0, ge=0)
    coulomb_Nm: float = Field(0.0, ge=0)


class PlantSettings(_Settings):
    """The arm: links from the shoulder outwards, q1 from the downward vertical."""

    links: tuple[LinkSettings, ...] = Field(min_length=1)
    gravity_m_s2: float = Field(
        0.0, ge=0, description="9.81 for a vertical arm, 0 for a horizontal one"
    )
    tanh_slope_s_rad: float = Field(50.0, gt=0, description="D in tau_f = B dq + C tanh(D dq)")
    substep_s: float = Field(
        250e-6, gt=0, description="must divide 500 us, the current loop's period"
    )
    q0_rad: tuple[float, ...] = Field(description="pose at power-on, at rest")
    is_held_until_enabled: bool = Field(
        True,
        description="the arm stays at its start pose (as on a stand) until a drive is energised",
    )


class ServoSettings(_Settings):
    """Motor winding, current loop and encoder of one axis (direct drive)."""

    torque_constant_Nm_A: float = Field(gt=0)
    resistance_ohm: float = Field(2.0, gt=0)
    inductance_H: float = Field(6e-3, gt=0)
    current_max_A: float = Field(10.0, gt=0)
    supply_V: float = Field(48.0, gt=0)
    bandwidth_Hz: float = Field(250.0, gt=0, description="of the 2 kHz PI current loop")
    encoder_bits: int = Field(12, ge=8, le=24)
    encoder_offset_counts: int = Field(0, description="count read at joint angle zero")


class EmulatorSettings(_Settings):
    """How emulated time runs."""

    time: Literal["lockstep", "wall"] = Field(
        "lockstep",
        description="lockstep: the plant advances one period per SYNC; wall: free-running",
    )
    stall_timeout_s: float = Field(
        0.5,
        gt=0,
        description="lockstep only: without SYNC for this long, time runs by the wall clock",
    )
    is_ideal: bool = Field(
        False,
        description="`hil sim` only: no frames, true position and velocity, torque after 0.5 ms "
        "delay and 0.5 ms lag",
    )
