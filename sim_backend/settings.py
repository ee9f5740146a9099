"""What can be set of the emulated arm and its amplifiers."""

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drivers.fault_frame import DURATION_MAX_S, FaultKind, FaultOrder, FaultTarget


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class DrivetrainSettings(_Settings):
    """A rotor in front of its joint, behind a gap with compliant flanks.

    Everything is seen at the joint: a rotor behind a gear of ratio N counts N**2 times. The rotor
    turns relative to the previous link and its spin does not load that link otherwise (Spong 1987,
    "Modeling and Control of Elastic Joint Robots", assumption A2).
    """

    rotor_inertia_kg_m2: float = Field(gt=0, description="added to the link's own")
    gap_rad: float = Field(0.0, ge=0, description="whole play: half on either side")
    stiffness_Nm_rad: float = Field(1e4, gt=0, description="of a flank in contact")
    damping_Nms_rad: float = Field(1.0, ge=0, description="of a flank in contact; never pulls")
    viscous_Nms_rad: float = Field(0.0, ge=0, description="of the rotor, before the gap")
    coulomb_Nm: float = Field(0.0, ge=0, description="of the rotor, before the gap")
    encoder: Literal["motor", "link"] = Field("motor", description="the side the encoder is on")


class LinkSettings(_Settings):
    """One rigid link, and friction, stops and drivetrain of the joint that carries it."""

    length_m: float = Field(gt=0)
    com_m: float = Field(gt=0, description="joint to centre of mass")
    mass_kg: float = Field(gt=0)
    inertia_kg_m2: float = Field(gt=0, description="about the centre of mass")
    viscous_Nms_rad: float = Field(0.0, ge=0)
    coulomb_Nm: float = Field(0.0, ge=0)
    static_Nm: float | None = Field(
        None,
        gt=0,
        description="Cs of the Stribeck curve, at least coulomb_Nm; left out, there is none",
    )
    stribeck_rad_s: float = Field(0.1, gt=0, description="vs of the Stribeck curve")
    q_min_rad: float | None = Field(None, description="lower joint stop; left out, there is none")
    q_max_rad: float | None = Field(None, description="upper joint stop; left out, there is none")
    drivetrain: DrivetrainSettings | None = Field(
        None, description="left out, the motor drives the link directly"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.static_Nm is not None and self.static_Nm < self.coulomb_Nm:
            raise ValueError(
                f"static_Nm = {self.static_Nm:g} is below coulomb_Nm = {self.coulomb_Nm:g}:"
                " static friction is at least Coulomb friction"
            )
        low, high = self.q_min_rad, self.q_max_rad
        if low is not None and high is not None and low >= high:
            raise ValueError(f"q_min_rad = {low:g} must be below q_max_rad = {high:g}")
        return self


class DisturbanceSettings(_Settings):
    """A torque about a joint that no motor makes; it reacts on the previous link.

    With a drivetrain it acts on the link. A constant one without end is a load step. A sine starts
    at zero, upwards.
    """

    joint: int = Field(ge=1, description="1 is the shoulder")
    kind: Literal["constant", "sine"] = "constant"
    torque_Nm: float = Field(description="value, or amplitude of the sine")
    frequency_Hz: float | None = Field(None, gt=0, description="of the sine")
    start_s: float = Field(0.0, ge=0, description="since the arm was let go")
    end_s: float | None = Field(None, description="left out, it lasts")

    @model_validator(mode="after")
    def _check(self) -> Self:
        if (self.frequency_Hz is None) == (self.kind == "sine"):
            need = "needs" if self.kind == "sine" else "has no"
            raise ValueError(f"a {self.kind} disturbance {need} frequency_Hz")
        _require_order("start_s", self.start_s, "end_s", self.end_s)
        return self


class PayloadSettings(_Settings):
    """An object at the tip of the last link, picked up and dropped at set times."""

    mass_kg: float = Field(gt=0)
    inertia_kg_m2: float = Field(0.0, ge=0, description="about its own centre, which is the tip")
    pick_s: float = Field(
        0.0, ge=0, description="since the arm was let go, to the nearest substep; 0: from the start"
    )
    drop_s: float | None = Field(None, description="left out, it is kept")
    is_at_rest: bool = Field(
        False,
        description="the object rests until it is picked up, which jolts the arm; else it moves"
        " with the hand",
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        _require_order("pick_s", self.pick_s, "drop_s", self.drop_s)
        return self


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
    disturbances: tuple[DisturbanceSettings, ...] = Field(
        (), description="times count while the arm is not held"
    )
    payloads: tuple[PayloadSettings, ...] = Field(
        (), description="times count while the arm is not held"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        for number, disturbance in enumerate(self.disturbances, 1):
            if disturbance.joint > len(self.links):
                raise ValueError(
                    f"disturbance {number} acts on joint {disturbance.joint}:"
                    f" this arm has {len(self.links)}"
                )
        for joint, (link, q_rad) in enumerate(zip(self.links, self.q0_rad, strict=False), 1):
            low, high = link.q_min_rad, link.q_max_rad
            if (low is not None and q_rad < low) or (high is not None and q_rad > high):
                raise ValueError(
                    f"q0_rad of joint {joint} is {q_rad:g}, outside its stops"
                    f" (q_min_rad = {low}, q_max_rad = {high})"
                )
        return self


class ServoSettings(_Settings):
    """Motor winding, current loop and encoder of one axis.

    Torque constant and encoder are seen at the joint. Which side of a drivetrain the encoder is on
    is the plant's to say (`DrivetrainSettings.encoder`).
    """

    torque_constant_Nm_A: float = Field(gt=0)
    resistance_ohm: float = Field(2.0, gt=0)
    inductance_H: float = Field(6e-3, gt=0)
    current_max_A: float = Field(10.0, gt=0)
    supply_V: float = Field(48.0, gt=0)
    bandwidth_Hz: float = Field(250.0, gt=0, description="of the 2 kHz PI current loop")
    encoder_bits: int = Field(12, ge=8, le=24)
    encoder_offset_counts: int = Field(0, description="count read at joint angle zero")
    command_delay_s: float = Field(
        0.0, ge=0, le=0.1, description="from the torque demand to the current loop, in whole 500 us"
    )


class WireSettings(_Settings):
    """The wire model: frame times to the bit, arbitration, errors. Its bit rates are the bus's."""

    is_on: bool = Field(
        False,
        description="off: frames take no time. On, time runs as hardware's does: in virtual time "
        "under `hil sim`, on the unix bus by the clock (`emulator.time`)",
    )
    bit_error_rate: float = Field(
        0.0, ge=0, le=0.01, description="probability that a bit is disturbed, for all to see"
    )
    seed: int = Field(1, ge=0, description="of the generator of bit errors")
    is_recovering: bool = Field(
        True, description="a node that is bus-off returns after 128 times 11 recessive bits"
    )
    window_s: float = Field(1.0, gt=0, description="the bus load is reported over so long")


class ScheduledFault(_Settings):
    """A fault that comes by itself at a set time (`sim_backend.faults` says what each does)."""

    target: Literal["encoder", "amplifier", "bus", "host"]
    kind: Literal["ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    joint: int = Field(0, ge=0, le=255, description="1 is the shoulder, 0 all; not of bus and host")
    start_s: float = Field(ge=0, description="since the arm was let go, in whole ms")
    duration_s: float | None = Field(
        None, ge=1e-3, le=DURATION_MAX_S, description="left out, until a fault `ok`"
    )

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.joint and self.target in ("bus", "host"):
            raise ValueError(f"the {self.target} belongs to no joint; leave joint out")
        return self

    def order(self) -> FaultOrder:
        """Return what a fault frame would say."""
        target, kind = FaultTarget[self.target.upper()], FaultKind[self.kind.upper()]
        return FaultOrder(target, kind, self.joint, round((self.duration_s or 0.0) * 1e3))


class FaultSettings(_Settings):
    """Sizes of the emulator's faults, and those that come by themselves."""

    schedule: tuple[ScheduledFault, ...] = ()
    seed: int = Field(1, ge=0, description="of the generator of garbage")
    shift_rad: float = Field(0.25, description="encoder `wrong`: it reads so much too much")
    hold_ms: int = Field(
        20, ge=1, le=1000, description="encoder and amplifier `slow`, encoder `delayed`"
    )
    interrupt_ms: int = Field(10, ge=1, description="`intermittent`: so long without ...")
    interrupt_every_ms: int = Field(100, ge=2, description="... so often")


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
    wire: WireSettings = Field(WireSettings(), description="the wire model, off by default")
    faults: FaultSettings = Field(FaultSettings(), description="none by default")


def _require_order(start: str, start_s: float, end: str, end_s: float | None) -> None:
    if end_s is not None and end_s <= start_s:
        raise ValueError(f"{end} = {end_s:g} s must be later than {start} = {start_s:g} s")
