"""What clients ask for and are answered: JSON over Zenoh, one model per command.

Units are SI, angles in rad, lists have one entry per joint, shoulder first. Whether a request
suits the arm (joints, limits, state) is decided later; here only its form is.
"""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Final, Literal, Self, TypeAlias, Union

from pydantic import (
    BaseModel,
    ConfigDict,
    FailFast,
    Field,
    Strict,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from hil.errors import HilError

MAX_JOINTS: Final = 16
MAX_WAYPOINTS: Final = 10_000
MAX_SAMPLES: Final = 600_000
MAX_DURATION_S: Final = 3600.0
MAX_TRAJECTORY_BYTES: Final = 8 << 20
MAX_COMMAND_BYTES: Final = 16 << 10
"""Longer payloads are refused unread: reading one holds up everything else in the process."""
PROTOCOL_VERSION: Final = 1
"""Changes when a client of an older one would be misunderstood; new optional fields do not."""
_MAX_REASON: Final = 300

Real = Annotated[float, Strict()]
"""A number, not a string or a boolean that looks like one."""
Joints = Annotated[list[Real], Field(min_length=1, max_length=MAX_JOINTS), FailFast()]
Times = Annotated[list[Real], Field(min_length=2, max_length=MAX_WAYPOINTS), FailFast()]
Points = Annotated[list[Joints], Field(min_length=2, max_length=MAX_WAYPOINTS), FailFast()]
Samples = Annotated[list[Joints], Field(min_length=5, max_length=MAX_SAMPLES), FailFast()]
Duration = Annotated[Real, Field(gt=0, le=MAX_DURATION_S)]
Text = Annotated[str, Field(max_length=64)]
OperatorName = Annotated[
    str, Field(max_length=64, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.@-]*$", strict=True)
]
"""One chunk of a Zenoh key: the operator's liveliness token is `hil/<arm>/operator/<name>`."""
Nanoseconds = Annotated[int, Field(ge=0, lt=1 << 63, strict=True)]
Code = Literal["held", "no_authority", "stale", "repeated_id", "busy"]
"""Why a request was not even looked at; see `Reply.code`."""


class RequestError(HilError):
    """A request could not be understood. Nothing has changed."""


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Request(_Message):
    version: Literal[1] = Field(1, description="of these messages")
    request_id: Text | None = Field(
        None, description="new for every request; sent again, it gets the first answer again"
    )


class _Order(_Request):
    """A request that takes authority; `request_id` is required."""

    lease: Text | None = Field(None, description="required: as `acquire` has answered it")
    sent_ns: Nanoseconds | None = Field(
        None,
        description="required: when it was sent, by the daemon's clock: the `t_ns` that `acquire` "
        "has answered and the time since",
    )


class AcquireRequest(_Request):
    """Take authority over the arm; refused while another operator holds it."""

    operator: OperatorName = Field(
        description="unique to the session; it has declared the liveliness token `operator/NAME`"
    )


class ReleaseRequest(_Order):
    """Give authority back. The arm goes on with what it does."""


class EnableRequest(_Order):
    """Enable the amplifiers; the reference starts at the measured pose."""


class DisableRequest(_Order):
    """Come to a damped stop, then disable the amplifiers."""


class StopRequest(_Order):
    """Slow down along the running trajectory and hold."""


class EstopRequest(_Message):
    """Take torque off at once; latched until a reset. Takes no authority and is never too old."""

    version: int = Field(PROTOCOL_VERSION, description="any: a stop is a stop")
    request_id: Text | None = Field(None, description="any text; the reply carries it")
    operator: OperatorName | None = Field(None, description="who asks, for the record")


class ResetRequest(_Order):
    """Clear a latched fault or emergency stop."""


class _Motion(_Order):
    approach: Literal["blend", "none"] = Field(
        "blend",
        description="blend: first move from the present reference to the start of the trajectory; "
        "none: begin at once, if the start is within the following-error limit",
    )


class WaypointsRequest(_Motion):
    """Timed points, joined by the curve of least squared jerk, at rest at both ends."""

    kind: Literal["waypoints"] = "waypoints"
    times_s: Times = Field(description="from 0, rising")
    points_rad: Points = Field(description="one list of joint angles per time")


class ExponentialSineRequest(_Motion):
    """q = b h + c h sin(w s), h = 1 - exp(-2 s^3), s = rate * t."""

    kind: Literal["exponential_sine"] = "exponential_sine"
    duration_s: Duration
    rate: Real = Field(1.0, gt=0, le=20)
    b_rad: Joints
    c_rad: Joints
    w_rad_s: Joints


class KellyRequest(_Motion):
    """The exponential-sine trajectory with the figures for the two-joint arm it was made for."""

    kind: Literal["kelly"] = "kelly"
    duration_s: Duration
    rate: Real = Field(1.0, gt=0, le=20, description="kelly: 1, kelly_2: 0.5, kelly_4: 0.25")


class SinusoidRequest(_Motion):
    """q = center + r(t) amplitude sin(2 pi f t + phase); r rises smoothly from 0 to 1."""

    kind: Literal["sinusoid"] = "sinusoid"
    duration_s: Duration
    center_rad: Joints
    amplitude_rad: Joints
    frequency_Hz: Joints
    phase_rad: list[Real] = Field([], max_length=MAX_JOINTS, description="0 if left out")
    ramp_s: Duration = 1.0


class SamplesRequest(_Motion):
    """Equidistant samples, resampled to the control period by a C2 curve through them."""

    kind: Literal["samples"] = "samples"
    period_s: Real = Field(ge=1e-4, le=10)
    q_rad: Samples = Field(description="one list of joint angles per sample")


class MoveRequest(_Order):
    """The fastest jerk-limited move from the present reference to a pose, at rest there."""

    kind: Literal["move"] = "move"
    target_rad: Joints
    speed_scale: Real = Field(
        1.0, ge=0.001, le=1, description="slows the whole move: half takes twice the time from rest"
    )


TrajectoryRequest: TypeAlias = Annotated[
    Union[  # noqa: UP007 - a chain of bars would not take the discriminator on Python 3.11
        WaypointsRequest,
        ExponentialSineRequest,
        KellyRequest,
        SinusoidRequest,
        SamplesRequest,
        MoveRequest,
    ],
    Field(discriminator="kind"),
]


class GainBoundsRequest(_Order):
    """Move the bounds of the self-tuned gain, Nm s/rad; the ceilings are the configuration's."""

    Kd_min: Joints
    Kd_max: Joints

    @model_validator(mode="after")
    def _check_order(self) -> Self:
        if len(self.Kd_min) != len(self.Kd_max):
            raise ValueError(f"{len(self.Kd_min)} values in Kd_min, {len(self.Kd_max)} in Kd_max")
        for joint, (low, high) in enumerate(zip(self.Kd_min, self.Kd_max, strict=True), start=1):
            if not 0.0 < low <= high:
                raise ValueError(f"joint {joint}: need 0 < Kd_min {low:g} <= Kd_max {high:g}")
        return self


class FaultRequest(_Order):
    """Inject a fault into the emulator, or clear it with `ok`."""

    target: Literal["encoder", "amplifier", "bus", "host"]
    joint: int | None = Field(
        None, ge=1, le=MAX_JOINTS, strict=True, description="1 is the shoulder; none: every joint"
    )
    kind: Literal["ok", "off", "stuck", "garbage", "wrong", "slow", "delayed", "intermittent"]
    duration_s: Real | None = Field(
        None,
        ge=1e-3,
        le=MAX_DURATION_S,
        description="emulated time, in whole ms; none: until it is ended by `ok`",
    )

    @model_validator(mode="after")
    def _check_joint(self) -> Self:
        if self.joint is not None and self.target in ("bus", "host"):
            raise ValueError(f"the {self.target} belongs to no joint; leave joint out")
        return self


Order: TypeAlias = (
    ReleaseRequest
    | EnableRequest
    | DisableRequest
    | StopRequest
    | ResetRequest
    | WaypointsRequest
    | ExponentialSineRequest
    | KellyRequest
    | SinusoidRequest
    | SamplesRequest
    | MoveRequest
    | GainBoundsRequest
    | FaultRequest
)
"""Takes authority."""
Request: TypeAlias = Order | AcquireRequest | EstopRequest


class Reply(_Message):
    """What a command answers. A refusal changed nothing.

    A refusal by a limit names it in numbers: `quantity` of `joint` (1 is the shoulder) would be
    `value`, the limit is `limit`; in SI units.
    """

    ok: bool
    reason: str = Field("", description="one line; empty if ok")
    request_id: str | None = None
    quantity: str | None = None
    joint: int | None = None
    value: float | None = None
    limit: float | None = None
    duration_s: float | None = Field(
        None, description="of an accepted trajectory, approach and final braking included"
    )
    cycle: int | None = Field(None, description="of the loop, in which it had taken effect")
    code: Code | None = Field(
        None,
        description="of a refusal that has nothing to do with the arm: held by another; "
        "no_authority: not or no longer yours; stale: too old; repeated_id: used for another "
        "request; busy: too many requests at once",
    )
    holder: str | None = Field(None, description="of a refusal for lack of authority: who has it")
    lease: str | None = Field(None, description="of `acquire`: goes into every request")
    t_ns: int | None = Field(None, description="of `acquire`: the daemon's clock")


COMMANDS: Final[Mapping[str, TypeAdapter[Any]]] = MappingProxyType(
    {
        "acquire": TypeAdapter(AcquireRequest),
        "release": TypeAdapter(ReleaseRequest),
        "enable": TypeAdapter(EnableRequest),
        "disable": TypeAdapter(DisableRequest),
        "stop": TypeAdapter(StopRequest),
        "estop": TypeAdapter(EstopRequest),
        "reset": TypeAdapter(ResetRequest),
        "trajectory": TypeAdapter(TrajectoryRequest),
        "gain_bounds": TypeAdapter(GainBoundsRequest),
        "fault": TypeAdapter(FaultRequest),
    }
)
"""What `cmd/<name>` takes."""


def parse(command: str, payload: bytes | str) -> Request:
    """Read the payload of `cmd/<command>`; an empty payload is an empty object.

    Raises:
        RequestError: If the command is unknown, or the payload is not what it takes; one line.
    """
    adapter = COMMANDS.get(command)
    if adapter is None:
        raise RequestError(f"command {command[:64]!r} is unknown; known: {', '.join(COMMANDS)}")
    check_size(command, len(payload))
    try:
        request: Request = adapter.validate_json(payload or b"{}")
    except ValidationError as error:
        raise RequestError(f"{command}: {explain(error)}") from error
    return request


def check_size(command: str, size: int) -> None:
    """Refuse a payload of so many bytes if it is too long for `cmd/<command>`.

    Raises:
        RequestError: With the limit.
    """
    most = MAX_TRAJECTORY_BYTES if command == "trajectory" else MAX_COMMAND_BYTES
    if size > most:
        raise RequestError(f"{command[:64]}: payload of {size} bytes is beyond {most} bytes")


def parse_trajectory(payload: bytes | str) -> TrajectoryRequest:
    """Read the payload of `cmd/trajectory`.

    Raises:
        RequestError: As for `parse`.
    """
    request: TrajectoryRequest = parse("trajectory", payload)  # type: ignore[assignment] # by its adapter
    return request


def explain(error: ValidationError) -> str:
    """Say in one line where a message is wrong, what is wrong, and what stood there."""
    first = error.errors(include_url=False, include_context=False)[0]
    text = f"{_place(first['loc'])}{first['msg']}"
    if first["type"] != "json_invalid":
        text += _got(first["input"])
    more = error.error_count() - 1
    if more:
        text += f" (and {more} more)"
    return _one_line(text)


def schemas() -> dict[str, dict[str, Any]]:
    """Return the JSON Schema of every command's request, and of `reply`."""
    known = {name: adapter.json_schema() for name, adapter in COMMANDS.items()}
    return known | {"reply": Reply.model_json_schema()}


def contract() -> dict[str, Any]:
    """Return what `schema` answers: the version, all JSON Schemas, and telemetry's `.proto`."""
    proto = (Path(__file__).parent / "proto" / "telemetry.proto").read_text(encoding="utf-8")
    return {"version": PROTOCOL_VERSION, **schemas(), "proto": proto}


def _got(given: object) -> str:
    if isinstance(given, int) and given.bit_length() > 64:
        return ", got a number beyond 64 bits"  # Python itself refuses to print the longest
    if isinstance(given, str):
        return f", got {given[:40]!r}"
    return f", got {given}" if isinstance(given, int | float) else ""


def _place(loc: tuple[int | str, ...]) -> str:
    place = ""
    for part in loc:
        place += f"[{part}]" if isinstance(part, int) else f".{part[:64]}"
    return f"{place.lstrip('.')}: " if place else ""


def _one_line(text: str) -> str:
    shown = "".join(c if c.isprintable() else " " for c in text)
    return shown if len(shown) <= _MAX_REASON else shown[: _MAX_REASON - 3] + "..."
