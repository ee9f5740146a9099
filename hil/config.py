"""The configuration: one TOML file, validated; command line > environment > file > default.

What the file leaves out comes from the arm preset. Environment variables are `HIL_` plus the
setting's path with `__` between the parts, for example `HIL_LOOP__REALTIME=best_effort`.
"""

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, Self

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    SerializerFunctionWrapHandler,
    ValidationError,
    model_serializer,
    model_validator,
)
from pydantic_settings import (
    BaseSettings,
    EnvSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)

from controller.settings import ControllerSettings, LinkModel, ModelSettings
from drivers.bus import split_address
from drivers.cia402.settings import Cia402Settings
from drivers.errors import DriverError
from drivers.registry import SETTINGS, AnyAxisSettings, axes_by_bus, find_clash
from drivers.settings import MOST_BUSES
from hil.chain_gains import C_RAD_S2, chain_controller
from hil.endpoints import reachable
from hil.errors import HilError
from sim_backend.errors import SimError
from sim_backend.presets import is_chain, plant_preset, servo_preset
from sim_backend.settings import EmulatorSettings, PlantSettings, ServoSettings

DEFAULT_PRESET = "bench_h"


class ConfigError(HilError):
    """The configuration cannot be used; the message says which setting and why."""


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ArmSettings(_Settings):
    """Which arm this is."""

    name: str = Field("bench", pattern=r"^[A-Za-z0-9_-]{1,32}$", description="Zenoh: hil/NAME/...")
    preset: str = Field(DEFAULT_PRESET, description="source of every setting left out")


class BusSettings(_Settings):
    """The bus the amplifiers are on, or the buses."""

    address: str = Field("unix:/tmp/hil-bench.sock", description="see `hil run --help`")
    more: tuple[str, ...] = Field(
        (),
        max_length=MOST_BUSES - 1,
        description="addresses of buses 2, 3 and 4; `axes.N.bus` says where an amplifier is",
    )
    bit_rate: int = Field(1_000_000, ge=10_000, le=1_000_000, description="bit/s, for the budget")
    data_bit_rate: int = Field(
        5_000_000, ge=10_000, le=8_000_000, description="the same for the data of CAN FD frames"
    )

    @property
    def addresses(self) -> tuple[str, ...]:
        """Of all buses, in the order of their numbers."""
        return (self.address, *self.more)

    @model_serializer(mode="wrap")
    def _leave_out_no_more(self, dump: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A configuration of one bus reads as it did when there were no others."""
        table: dict[str, Any] = dump(self)
        if not self.more:
            table.pop("more", None)
        return table


class LoopSettings(_Settings):
    """The control loop's timing and rights."""

    period_s: float = Field(1e-3, ge=1e-3, le=10e-3, description="of the control cycle")
    realtime: Literal["required", "best_effort", "off"] = Field(
        "required", description="SCHED_FIFO, locked memory; `required` fails when not granted"
    )
    priority: int = Field(80, ge=1, le=98, description="of SCHED_FIFO")
    cpu: int | None = Field(None, ge=0, description="core to run on; none = any")
    spin: bool = Field(
        False, description="wait for period and feedback by looking, not asleep; takes a whole core"
    )
    feedback_timeout_s: float = Field(
        0.6e-3, gt=0, description="after the start of a cycle; later feedback is missing"
    )
    lockstep_timeout_s: float = Field(
        1.0, gt=0, description="the same for emulated amplifiers in lockstep, whose time waits"
    )
    enable_timeout_s: float = Field(
        1.0, gt=0, description="amplifiers that are not on after this are a fault"
    )
    on_gateway_loss: Literal["finish", "hold", "stop"] = Field(
        "finish", description="finish: the trajectory, then hold; hold: slow down now; stop: damped"
    )


class TrajectorySettings(_Settings):
    """What may be sent as one trajectory."""

    max_duration_s: float = Field(
        120.0, gt=0, le=3600, description="longer ones are refused; sizes the shared memory"
    )


class ZenohSettings(_Settings):
    """How clients reach the daemon."""

    mode: Literal["peer", "client", "router"] = Field(
        "peer", description="client: through the router in `connect` alone"
    )
    listen: tuple[str, ...] = Field(
        ("tcp/127.0.0.1:7447",), description="endpoints of this daemon; loopback only by default"
    )
    connect: tuple[str, ...] = Field((), description="endpoints of routers or peers to join")
    multicast_scouting: bool = Field(False, description="look for others on the local network")
    file: str | None = Field(
        None,
        description="Zenoh's own JSON5 file with certificates, passwords and access control, as "
        "`hil keys init` writes it; mode and endpoints are taken from here, `connect` if given",
    )
    allow_open: bool = Field(
        False, description="let anyone who reaches the daemon over the network command it"
    )

    @model_validator(mode="after")
    def _check_open(self) -> Self:
        """Refuse what is open for certain; what `file` asks for is looked at when it is opened."""
        found = reachable(self.listen)
        if self.multicast_scouting:
            found.append("multicast_scouting")
        if found and not (self.file or self.allow_open):
            raise ValueError(
                f"{found[0]} reaches beyond this host and nobody is asked who they are: set "
                "zenoh.file (`hil keys init` makes one), or zenoh.allow_open = true"
            )
        return self


class RemoteSettings(_Settings):
    """Authority: who may move the arm over the network, and for how long."""

    on_operator_loss: Literal["finish", "hold", "stop"] = Field(
        "hold",
        description="when the operator's program or link dies in mid-motion: finish the "
        "trajectory, then hold; hold: slow down now; stop: damped, then power off",
    )
    max_age_s: float = Field(
        10.0, gt=0, le=60, description="requests that are older when their turn comes are refused"
    )
    idle_s: float | None = Field(
        900.0,
        gt=0,
        description="an operator who asks for nothing for so long, and whose arm does not move, "
        "loses authority to whoever asks next; none = never",
    )
    reconnect_s: float = Field(
        10.0, gt=0, le=60, description="time the operator has to reconnect to a restarted gateway"
    )


class RecordingSettings(_Settings):
    """Where runs are recorded, and how much of the disk they may take."""

    directory: str = Field("runs", description="of recordings that are not named by `--record`")
    is_enabled: bool = Field(True, description="`--record FILE` records all the same")
    max_size_MB: float = Field(1000.0, gt=0, description="of a file; then the next one begins")
    max_age_s: float = Field(3600.0, gt=0, description="of a file; then the next one begins")
    disk_budget_MB: float | None = Field(
        None, gt=0, description="of all of the arm's recordings; the oldest are removed; none = all"
    )
    min_free_MB: float = Field(200.0, ge=0, description="less free space ends the recording")

    @model_validator(mode="after")
    def _check_budget(self) -> Self:
        budget, size = self.disk_budget_MB, self.max_size_MB
        if budget is not None and budget < 2 * size:
            raise ValueError(
                f"disk_budget_MB {budget:g} must be at least twice max_size_MB {size:g}: "
                "raise the budget or lower the size of a file"
            )
        return self


class Config(BaseSettings):
    """Everything that can be set. Per-joint lists have one entry per joint, shoulder first."""

    model_config = SettingsConfigDict(
        extra="forbid",
        frozen=True,
        env_prefix="HIL_",
        env_nested_delimiter="__",
        allow_inf_nan=False,
    )

    arm: ArmSettings = ArmSettings()
    bus: BusSettings = BusSettings()
    axes: tuple[AnyAxisSettings, ...] = Field(min_length=1)
    controller: ControllerSettings
    loop: LoopSettings = LoopSettings()
    trajectory: TrajectorySettings = TrajectorySettings()
    zenoh: ZenohSettings = ZenohSettings()
    remote: RemoteSettings = RemoteSettings()
    recording: RecordingSettings = RecordingSettings()
    plant: PlantSettings = Field(description="the emulated arm")
    servos: tuple[ServoSettings, ...] = Field(description="the emulated motors")
    emulator: EmulatorSettings = EmulatorSettings()
    scenario: str | None = Field(None, description="name of the reference scenario being run")

    @classmethod
    def settings_customise_sources(
        cls,
        settings_cls: type[BaseSettings],
        init_settings: PydanticBaseSettingsSource,
        env_settings: PydanticBaseSettingsSource,
        dotenv_settings: PydanticBaseSettingsSource,
        file_secret_settings: PydanticBaseSettingsSource,
    ) -> tuple[PydanticBaseSettingsSource, ...]:
        """Take only what is given: `load_config` has laid all sources together."""
        del settings_cls, env_settings, dotenv_settings, file_secret_settings
        return (init_settings,)

    @model_validator(mode="before")
    @classmethod
    def _fill_from_preset(cls, data: dict[str, Any]) -> dict[str, Any]:
        arm = data.get("arm") or {}
        name = arm.get("preset", DEFAULT_PRESET) if isinstance(arm, Mapping) else DEFAULT_PRESET
        try:
            defaults = preset_defaults(str(name))
            defaults["axes"] = _axes_of_families(defaults["axes"], data.get("axes"))
            return merge(defaults, data)
        except SimError as error:
            raise ValueError(str(error)) from error

    @model_validator(mode="after")
    def _check(self) -> Self:
        joints = self.joints
        for name, given in (("plant.links", self.plant.links), ("servos", self.servos),
                            ("plant.q0_rad", self.plant.q0_rad)):  # fmt: skip
            if len(given) != joints:
                raise ValueError(f"{name} has {len(given)} entries, axes has {joints}")
        self.controller.require_joints(joints)
        self._check_buses()
        for number, axes in enumerate(axes_by_bus(self.axes), start=1):
            nodes = [(axis.family, axis.node) for axis in axes]
            if len(set(nodes)) != len(nodes):
                shown = ", ".join(f"{family} {node}" for family, node in nodes)
                where = f" on bus {number}" if self.bus.more else ""
                raise ValueError(f"axes: node ids ({shown}){where} are not all different")
        if clash := find_clash(self.axes):
            raise ValueError(f"axes: {clash}")
        if self.loop.feedback_timeout_s >= self.loop.period_s:
            raise ValueError("loop.feedback_timeout_s must be shorter than loop.period_s")
        return self

    def _check_buses(self) -> None:
        addresses = self.bus.addresses
        if len(set(addresses)) != len(addresses):
            raise ValueError(f"bus.more: {', '.join(addresses)} are not all different")
        used = {axis.bus for axis in self.axes}
        for joint, axis in enumerate(self.axes, start=1):
            if axis.bus > len(addresses):
                raise ValueError(
                    f"axes.{joint}.bus is {axis.bus}, there {_buses(len(addresses))}; "
                    "add addresses to bus.more"
                )
        for number in range(1, len(addresses) + 1):
            if number not in used:
                raise ValueError(
                    f"no axis is on bus {number} ({addresses[number - 1]}); "
                    f"set axes.N.bus = {number}, or leave the bus out"
                )

    @property
    def joints(self) -> int:
        """Number of joints."""
        return len(self.axes)


def _buses(number: int) -> str:
    return "is 1 bus" if number == 1 else f"are {number} buses"


def preset_defaults(name: str) -> dict[str, Any]:
    """Return what an arm preset says about every setting that has no default of its own.

    Raises:
        SimError: If there is no such preset.
    """
    plant, servos = plant_preset(name), servo_preset(name)
    model = _nominal_model(plant)
    tau_max = [servo.torque_constant_Nm_A * servo.current_max_A for servo in servos]
    n = len(servos)
    limits: dict[str, Any] = {
        "q_min_rad": [-2.8] * n,
        "q_max_rad": [2.8] * n,
        "dq_max_rad_s": [4.0] * n,
        "dq_trip_rad_s": [15.0] * n,
        "ddq_max_rad_s2": [20.0] * n,
        "dddq_max_rad_s3": [500.0] * n,
        "tau_max_Nm": tau_max,
        "tau_slew_Nm_s": [500.0 * tau for tau in tau_max],
        "following_error_rad": [0.8] * n,
        "damping_Nms_rad": [1.0] * n,
    }
    axes = [Cia402Settings.defaults(j, tau) for j, tau in enumerate(tau_max, start=1)]
    controller: dict[str, Any] = {"limits": limits, "model": model}
    if is_chain(name):
        law, fitting = chain_controller(plant)
        velocity = {"C_rad_s2": [C_RAD_S2] * n}
        controller |= {"law": law, "limits": limits | fitting, "velocity": velocity}
    return {
        "arm": {"preset": name},
        "axes": axes,
        "controller": controller,
        "plant": plant.model_dump(),
        "servos": [servo.model_dump() for servo in servos],
    }


def _axes_of_families(axes: list[dict[str, Any]], given: object) -> list[dict[str, Any]]:
    """Return the preset's axes, those given another family with that family's defaults."""
    if not isinstance(given, Mapping):
        return axes
    chosen = list(axes)
    for place, table in given.items():
        family = table.get("family") if isinstance(table, Mapping) else None
        if family in SETTINGS and str(place).isdigit() and 1 <= int(place) <= len(axes):
            joint = int(place)
            tau_max_Nm = axes[joint - 1]["torque_max_Nm"]
            chosen[joint - 1] = SETTINGS[family].defaults(joint, tau_max_Nm)
    return chosen


def _nominal_model(plant: PlantSettings) -> dict[str, Any]:
    """Return what the model-based laws are told of an arm: `ModelSettings`, as a table."""
    known: dict[str, Any] = dict.fromkeys(ModelSettings.model_fields, True)
    return plant.model_dump(include=known | {"links": {"__all__": set(LinkModel.model_fields)}})


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` with `over` laid on it; tables are merged, everything else is replaced.

    A table with integer keys laid on a list changes single entries: `{"1": {...}}`.
    """
    merged = dict(base)
    for key, value in over.items():
        below = merged.get(key)
        if isinstance(value, Mapping) and isinstance(below, Mapping):
            merged[key] = merge(below, value)
        elif isinstance(value, Mapping) and isinstance(below, (list, tuple)):
            merged[key] = _merge_entries(key, below, value)
        else:
            merged[key] = value
    return merged


def _merge_entries(
    key: str, below: list[Any] | tuple[Any, ...], over: Mapping[str, Any]
) -> list[Any]:
    entries = list(below)
    for place, value in over.items():
        if not place.isdigit() or not 1 <= int(place) <= len(entries):
            raise ValueError(f"{key}.{place}: entries are numbered 1 to {len(entries)}")
        entry = entries[int(place) - 1]
        is_table = isinstance(value, Mapping) and isinstance(entry, Mapping)
        entries[int(place) - 1] = merge(entry, value) if is_table else value
    return entries


def parse_assignment(text: str) -> dict[str, Any]:
    """Turn `table.key=value` into a nested table; the value is read as TOML, else as text.

    Raises:
        ConfigError: If there is no `=` or no key.
    """
    path, equals, raw = text.partition("=")
    if not equals or not all(path.split(".")):
        raise ConfigError(f"--set {text!r}: write table.key=value, for example loop.cpu=1")
    try:
        value: Any = tomllib.loads(f"v = {raw}")["v"]
    except tomllib.TOMLDecodeError:
        value = raw
    for part in reversed(path.split(".")):
        value = {part: value}
    table: dict[str, Any] = value
    return table


def load_config(path: str | None = None, overrides: Mapping[str, Any] | None = None) -> Config:
    """Read and validate the configuration.

    Args:
        path: TOML file, or none for presets and defaults alone.
        overrides: From the command line; they win over everything.

    Raises:
        ConfigError: With one line that names the file, the setting, the value and the reason.
    """
    source = path or "configuration"
    data = _read_toml(path) if path else {}
    try:
        config = Config(**merge(merge(data, EnvSettingsSource(Config)()), overrides or {}))
        for address in config.bus.addresses:
            split_address(address)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_first_problem(error)}") from error
    except (ValueError, DriverError) as error:
        raise ConfigError(f"{source}: {error}") from error
    return config


def config_from_json(text: str | bytes) -> Config:
    """Rebuild a configuration that `Config.model_dump_json` wrote; the environment is not asked."""
    return Config.model_validate_json(text)


def _read_toml(path: str) -> dict[str, Any]:
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror or error}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error


def _first_problem(error: ValidationError) -> str:
    problems = error.errors(include_url=False)
    first = problems[0]
    where = ".".join(str(part) for part in first["loc"])
    value = first.get("input")
    shown = (
        ""
        if isinstance(value, (Mapping, list, tuple))
        else f" (got {json.dumps(value, default=str)})"
    )
    more = f"; and {len(problems) - 1} more" if len(problems) > 1 else ""
    message = first["msg"].removeprefix("Value error, ")
    return f"{where + ': ' if where else ''}{message}{shown}{more}"
