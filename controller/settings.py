"""What can be set of the controller. Lists have one entry per joint, shoulder first."""

from collections.abc import Iterable
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Joints = tuple[float, ...]
LawName = Literal["self_tuning_pid", "self_tuning_pd", "pid", "pd", "computed_torque", "slotine_li"]
PER_JOINT = 5
"""Parameters per joint of the model-based laws: J, b, B, C, tau_d (`controller.model_based`)."""
MODEL_BASED = ("computed_torque", "slotine_li")
"""Laws that need `ControllerSettings.model`."""
MembershipName = Literal["sigmoid", "gaussian_normalised", "gaussian_clipped", "triangular"]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _require_lengths(settings: BaseModel, names: Iterable[str], joints: int) -> None:
    for name in names:
        given = len(getattr(settings, name))
        if given != joints:
            raise ValueError(f"{name} has {given} entries, the arm has {joints} joints")


def _require_above_zero(settings: BaseModel, names: Iterable[str]) -> None:
    for name in names:
        for j, value in enumerate(getattr(settings, name), start=1):
            if not value > 0.0:
                raise ValueError(f"joint {j}: {name} {value:g} must be above 0")


def _require_not_negative(settings: BaseModel, name: str) -> None:
    for j, value in enumerate(getattr(settings, name), start=1):
        if value < 0.0:
            raise ValueError(f"joint {j}: {name} {value:g} must not be below 0")


class VelocitySettings(_Settings):
    """How joint velocity is estimated from the encoder."""

    estimator: Literal["filtered_difference", "levant", "amplifier"] = Field(
        "filtered_difference", description="amplifier: take the rate the amplifier reports"
    )
    cutoff_Hz: float = Field(30.0, gt=0, description="of the filtered difference")
    C_rad_s2: Joints = Field(
        (50.0, 100.0),
        description="Levant: bound on the acceleration, 0.4 to 0.7 of the peak or more",
    )
    lock_tolerance_rad: float = Field(
        0.05,
        gt=0,
        description="Levant: position error beyond which lock is lost and the loop trips",
    )

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        _require_above_zero(self, ("C_rad_s2",))
        return self


class LawSettings(_Settings):
    """The paper's law: tau = -Kd S, S = S_q + Ki sigma (eqs 6, 7, 11, 16)."""

    name: LawName = "self_tuning_pid"
    alpha: Joints = (5.0, 7.5)
    lambda_: Joints = (10.0, 10.0)
    Ki: Joints = (0.2, 0.2)
    manifold: Literal["tanh", "sine", "saturation"] = Field(
        "tanh", description="f in sigma' = f(lambda S_q), paper 6.5"
    )
    Kd: Joints = Field((4.0, 4.0), description="gain of the constant-gain laws, Nm s/rad")
    Kd_min: Joints = (1.0, 1.0)
    Kd_max: Joints = (4.0, 4.0)
    Kd_floor: float = Field(0.1, gt=0, description="no gain bound may be set below this")
    Kd_ceiling: float = Field(8.0, gt=0, description="no gain bound may be set above this")
    Kd_ramp_per_s: float = Field(10.0, gt=0, description="how fast gain bounds move")
    beta: tuple[float, float, float] = Field(
        (1.0, 2.0, 4.0), description="linear consequences of the rules big, medium, small"
    )
    membership: MembershipName = Field(
        "sigmoid",
        description="of the rules; gaussian_clipped lets the plain sum (17) leave the gain bounds",
    )
    adaptation: Literal["off", "literal", "absolute", "true_sign"] = "literal"
    learning_rate: float = Field(
        1e-6, ge=0, description="eta * Upsilon of (28) per 1 ms; scaled with the period"
    )
    tuner: Literal["paper", "load_memory"] = Field(
        "paper",
        description="of the self-tuning laws; load_memory: ours, docs/tuner.md, in which "
        "membership, beta and adaptation have no part",
    )
    load_memory_s: float = Field(0.02, gt=0, description="load_memory: how far back it remembers")
    load_neutral: float = Field(
        0.4, ge=0, le=1, description="load_memory: place of the gain without load in its bounds"
    )
    load_knee_rad_s: float = Field(
        0.5, gt=0, description="load_memory: |S| beyond which Kd falls so that torque stays level"
    )
    tau_clip_Nm: Joints | None = Field(
        None,
        description="the law's own torque limit per joint, for comparisons at equal peak torque; "
        "the anti-windup heeds it",
    )

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        clip = () if self.tau_clip_Nm is None else ("tau_clip_Nm",)
        _require_above_zero(self, ("alpha", "lambda_", "Kd", *clip))
        _require_not_negative(self, "Ki")
        return self

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        for j, (low, high) in enumerate(zip(self.Kd_min, self.Kd_max, strict=False), start=1):
            if not self.Kd_floor <= low <= high <= self.Kd_ceiling:
                raise ValueError(
                    f"joint {j}: gain bounds ({low:g}, {high:g}) must rise and lie between "
                    f"Kd_floor {self.Kd_floor:g} and Kd_ceiling {self.Kd_ceiling:g}"
                )
        return self


class LinkModel(_Settings):
    """What the model-based laws take a link, and the friction of its joint, to be."""

    length_m: float = Field(gt=0)
    com_m: float = Field(ge=0, description="joint to centre of mass")
    mass_kg: float = Field(ge=0)
    inertia_kg_m2: float = Field(ge=0, description="about the centre of mass")
    viscous_Nms_rad: float = Field(0.0, ge=0)
    coulomb_Nm: float = Field(0.0, ge=0)


class ModelSettings(_Settings):
    """The arm as the model-based laws know it; the other laws do not look at it."""

    links: tuple[LinkModel, ...] = Field(min_length=1, description="from the shoulder outwards")
    gravity_m_s2: float = Field(0.0, ge=0, description="9.81 for a vertical arm, 0 if horizontal")
    tanh_slope_s_rad: float = Field(50.0, gt=0, description="D in tau_f = B dq + C tanh(D dq)")


class SlotineLiSettings(_Settings):
    """Adaptation of Theta (paper 3.2.2); per kind of parameter (J, b, B, C, tau_d)."""

    Gamma: Joints = Field(
        (0.04, 0.3, 0.3, 1.0, 0.0),
        description="Theta' = -Gamma Y_r' S_q, as 5 values for all joints or 5 for each; 0 leaves "
        "a parameter where it starts",
    )
    start: Literal["zero", "model"] = Field(
        "zero", description="Theta at power-on: nothing known, or controller.model"
    )
    Theta_max: tuple[float, float, float, float, float] | None = Field(
        None, description="box: J, b, B, C within 0 .. this, tau_d within +- this"
    )

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        for name, values in (("Gamma", self.Gamma), ("Theta_max", self.Theta_max or ())):
            if any(value < 0.0 for value in values):
                raise ValueError(f"{name} {values} must not be negative")
        return self


class MonitorSettings(_Settings):
    """How the monitors of S estimate what cannot be measured."""

    demand_cutoff_Hz: float = Field(
        5.0, gt=0, description="low-pass of the sent torque, the estimate of the required torque"
    )
    window_s: float = Field(2.0, gt=0, description="of the ultimate bound of |S|")


class LimitSettings(_Settings):
    """Limits checked every cycle, and those a trajectory is checked against beforehand."""

    q_min_rad: Joints = Field(description="soft limit: a trajectory may not pass it")
    q_max_rad: Joints
    hard_margin_rad: float = Field(0.1, gt=0, description="the hard limit lies this far beyond")
    dq_max_rad_s: Joints = Field(description="of trajectories")
    dq_trip_rad_s: Joints = Field(description="a joint measured to be faster takes torque off")
    ddq_max_rad_s2: Joints
    dddq_max_rad_s3: Joints
    tau_max_Nm: Joints
    tau_slew_Nm_s: Joints = Field(description="largest change of commanded torque per second")
    following_error_rad: Joints
    damping_Nms_rad: Joints = Field(description="of the damped stop: tau = -damping * dq")
    n_hold: int = Field(5, ge=0, description="cycles the last torque is held without feedback")
    n_damp: int = Field(20, ge=0, description="further cycles of damping before torque goes off")
    stop_timeout_s: float = Field(
        2.0, gt=0, description="a damped stop ends after this at the latest"
    )
    lowering_rad_s: float = Field(
        0.4, gt=0, description="a stop lets a vertical arm down at this rate (controller.model)"
    )
    lowering_timeout_s: float = Field(
        10.0, gt=0, description="stop_timeout_s of an arm that gravity pulls"
    )

    @model_validator(mode="after")
    def _check_signs(self) -> Self:
        _require_above_zero(
            self,
            ("dq_max_rad_s", "dq_trip_rad_s", "ddq_max_rad_s2", "dddq_max_rad_s3",
             "tau_max_Nm", "tau_slew_Nm_s", "following_error_rad"),
        )  # fmt: skip
        _require_not_negative(self, "damping_Nms_rad")
        for j, (low, high) in enumerate(zip(self.q_min_rad, self.q_max_rad, strict=False), start=1):
            if not low < high:
                raise ValueError(f"joint {j}: q_min_rad {low:g} must be below q_max_rad {high:g}")
        return self


class ControllerSettings(_Settings):
    """Law, estimator and limits of one arm."""

    law: LawSettings = LawSettings()
    velocity: VelocitySettings = VelocitySettings()
    limits: LimitSettings
    model: ModelSettings | None = Field(None, description="of the arm, for the model-based laws")
    slotine_li: SlotineLiSettings = SlotineLiSettings()
    monitor: MonitorSettings = MonitorSettings()

    @property
    def is_lowered(self) -> bool:
        """A stop lets the arm down: its model says that gravity pulls it."""
        return self.model is not None and self.model.gravity_m_s2 > 0.0

    @property
    def stop_time_s(self) -> float:
        """Time after which a damped stop is over at the latest."""
        limits = self.limits
        return limits.lowering_timeout_s if self.is_lowered else limits.stop_timeout_s

    def warnings(self) -> list[str]:
        """Say what is allowed and not advised, one line each."""
        law = self.law
        is_fuzzy = law.name.startswith("self_tuning") and law.tuner == "paper"
        if not is_fuzzy or law.membership != "gaussian_clipped":
            return []
        warning = (
            "controller.law.membership gaussian_clipped: the sum (17) leaves the gain bounds and is"
            " clipped, and torque falls where |S| grows; use gaussian_normalised"
        )
        return [warning]

    def require_joints(self, joints: int) -> None:
        """Check that every per-joint list has one entry per joint.

        Raises:
            ValueError: Naming the list, its length and the number of joints.
        """
        _require_lengths(self.law, ("alpha", "lambda_", "Ki", "Kd", "Kd_min", "Kd_max"), joints)
        if self.law.tau_clip_Nm is not None:
            _require_lengths(self.law, ("tau_clip_Nm",), joints)
        if self.law.name in MODEL_BASED:
            self._require_model(joints)
        if self.velocity.estimator == "levant":
            _require_lengths(self.velocity, ("C_rad_s2",), joints)
        limits = [
            name for name, value in LimitSettings.model_fields.items() if value.annotation == Joints
        ]
        _require_lengths(self.limits, limits, joints)

    def _require_model(self, joints: int) -> None:
        if self.model is None:
            raise ValueError(f"law {self.law.name} needs a model of the arm: controller.model")
        links = len(self.model.links)
        if links != joints:
            raise ValueError(f"model.links has {links} entries, the arm has {joints} joints")
        given, wanted = len(self.slotine_li.Gamma), (PER_JOINT, PER_JOINT * joints)
        if given not in wanted:
            raise ValueError(
                f"slotine_li.Gamma has {given} entries; give {PER_JOINT}, or {wanted[1]} for "
                f"{joints} joints"
            )
