"""What can be set of the controller. Lists have one entry per joint, shoulder first."""

from collections.abc import Iterable
from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Joints = tuple[float, ...]
LawName = Literal["self_tuning_pid", "self_tuning_pd", "pid", "pd"]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _require_lengths(settings: BaseModel, names: Iterable[str], joints: int) -> None:
    for name in names:
        given = len(getattr(settings, name))
        if given != joints:
            raise ValueError(f"{name} has {given} entries, the arm has {joints} joints")


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
    adaptation: Literal["off", "literal", "absolute", "true_sign"] = "literal"
    learning_rate: float = Field(
        1e-6, ge=0, description="eta * Upsilon of (28) per 1 ms; scaled with the period"
    )

    @model_validator(mode="after")
    def _check_bounds(self) -> Self:
        for j, (low, high) in enumerate(zip(self.Kd_min, self.Kd_max, strict=True), start=1):
            if not self.Kd_floor <= low <= high <= self.Kd_ceiling:
                raise ValueError(
                    f"joint {j}: gain bounds ({low:g}, {high:g}) must rise and lie between "
                    f"Kd_floor {self.Kd_floor:g} and Kd_ceiling {self.Kd_ceiling:g}"
                )
        return self


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


class ControllerSettings(_Settings):
    """Law, estimator and limits of one arm."""

    law: LawSettings = LawSettings()
    velocity: VelocitySettings = VelocitySettings()
    limits: LimitSettings

    def require_joints(self, joints: int) -> None:
        """Check that every per-joint list has one entry per joint.

        Raises:
            ValueError: Naming the list, its length and the number of joints.
        """
        _require_lengths(self.law, ("alpha", "lambda_", "Ki", "Kd", "Kd_min", "Kd_max"), joints)
        if self.velocity.estimator == "levant":
            _require_lengths(self.velocity, ("C_rad_s2",), joints)
        limits = [
            name for name, value in LimitSettings.model_fields.items() if value.annotation == Joints
        ]
        _require_lengths(self.limits, limits, joints)
