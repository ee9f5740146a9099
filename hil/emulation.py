"""Builds the emulated robot that a configuration describes."""

from collections.abc import Callable, Sequence

from drivers.bus import split_address
from drivers.cia402.settings import Cia402Settings
from drivers.mit.settings import MitSettings
from drivers.moteus.settings import MoteusSettings
from drivers.odrive.endpoints import EMULATED, load_endpoints
from drivers.odrive.settings import OdriveSettings
from hil.config import Config
from sim_backend.arm import Arm
from sim_backend.cia402 import node as cia402
from sim_backend.emulator import Emulator
from sim_backend.errors import SimError
from sim_backend.faults import Faults
from sim_backend.hub import Wire, open_wire
from sim_backend.mit.node import make_node
from sim_backend.mit.settings import MitNodeSettings
from sim_backend.moteus.node import MoteusNode, MoteusNodeSettings
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.odrive.node import OdriveNode, OdriveNodeSettings
from sim_backend.servo import Servo
from sim_backend.settings import EmulatorSettings
from sim_backend.timed_hub import TimedHub
from sim_backend.wire_group import WireGroup
from sim_backend.wired import Port


def build_emulator(
    config: Config, transmit: Transmit | Sequence[Transmit], *, is_lockstep: bool
) -> Emulator:
    """Return the arm of `config.plant` behind one emulated amplifier per entry of `config.axes`.

    Args:
        config: Plant, motors, and the axes whose families and identifiers are to be emulated.
        transmit: Puts a frame on the wire; of several buses one each, in their order.
        is_lockstep: What the amplifiers tell the master about their time, and how time begins.

    Raises:
        SimError: If the plant cannot be built as configured.
    """
    servos = [Servo(settings) for settings in config.servos]
    transmits = (transmit,) if callable(transmit) else transmit
    places = [axis.bus - 1 for axis in config.axes]
    outputs = [transmits[place] for place in places]
    faults = Faults(config.emulator.faults, servos, outputs, places)
    nodes = [
        _NODES[axis.family](axis, servo, faults.output(j), is_lockstep=is_lockstep)
        for j, (axis, servo) in enumerate(zip(config.axes, servos, strict=True))
    ]
    arm = Arm(config.plant)
    return Emulator(arm, servos, nodes, is_lockstep=is_lockstep, faults=faults, places=places)


def build_wired_emulator(config: Config, ports: Sequence[Port]) -> Emulator:
    """Return the same on the wire model: each amplifier at a port of its own, time by the clock.

    Raises:
        SimError: If the plant cannot be built as configured.
    """
    servos = [Servo(settings) for settings in config.servos]
    faults = Faults(config.emulator.faults, servos, [port.send for port in ports])
    nodes = [
        port.attach(_NODES[axis.family](axis, servo, faults.output(j), is_lockstep=False))
        for j, (axis, servo, port) in enumerate(zip(config.axes, servos, ports, strict=True))
    ]
    return Emulator(Arm(config.plant), servos, nodes, is_lockstep=False, faults=faults)


def open_emulation(config: Config, settings: EmulatorSettings) -> tuple[Wire, Emulator]:
    """Open the emulator's side of the bus, and build what is behind it.

    Args:
        config: As for `build_emulator`.
        settings: `config.emulator`, perhaps changed.

    Raises:
        SimError: If the bus cannot be opened, the plant cannot be built, or the wire model is
            asked for where it cannot be.
    """
    if settings.wire.is_on:
        wires: list[Wire] = [_open_timed_hub(config, settings)]
    else:
        wires = _open_wires(config.bus.addresses)
    wire = wires[0]
    try:
        if isinstance(wire, TimedHub):
            return wire, build_wired_emulator(config, wire.ports(config.joints))
        is_lockstep = settings.time == "lockstep"
        transmits = [each.transmit for each in wires]
        emulator = build_emulator(config, transmits, is_lockstep=is_lockstep)
        return (wire if len(wires) == 1 else WireGroup(wires, config.bus.addresses)), emulator
    except BaseException:
        for each in wires:
            each.close()
        raise


def _open_wires(addresses: Sequence[str]) -> list[Wire]:
    wires: list[Wire] = []
    try:
        for address in addresses:
            wires.append(open_wire(address))  # noqa: PERF401 - those that are open may have to be closed
    except BaseException:
        for wire in wires:
            wire.close()
        raise
    return wires


def require_one_bus(config: Config) -> None:
    """Refuse the wire model for an arm on several buses.

    Raises:
        SimError: If it is on several.
    """
    if config.bus.more:
        raise SimError(
            f"emulator.wire.is_on: the wire model is of one bus, this arm is on "
            f"{len(config.bus.addresses)}; switch it off, or put all axes on bus 1"
        )


def _open_timed_hub(config: Config, settings: EmulatorSettings) -> TimedHub:
    require_one_bus(config)
    scheme, path = split_address(config.bus.address)
    if scheme != "unix":
        raise SimError(
            f"emulator.wire.is_on: {config.bus.address} has a wire of its own; use unix:PATH, or "
            "switch it off"
        )
    if settings.time != "wall":
        raise SimError(
            "emulator.wire.is_on: over a bus frames take real time, not lockstep's; use "
            "--time wall, or `hil sim` for virtual time"
        )
    bus = config.bus
    return TimedHub(path, settings.wire, bit_rate=bus.bit_rate, data_bit_rate=bus.data_bit_rate)


def describe_load(wire: Wire) -> str:
    """Return a line about the bus's load so far, empty without the wire model."""
    if not isinstance(wire, TimedHub):
        return ""
    model, total = wire.model, wire.model.total
    share = total.busy_ns / max(1, model.now_ns)
    return (
        f"bus load {100 * share:.1f} % on average, at most {100 * model.peak_share:.1f} % over "
        f"{model.window_ns * 1e-9:g} s; {total.frames} frames, {total.errors} error frames, "
        f"longest wait {total.wait_max_ns * 1e-3:.0f} us"
    )


def _cia402(
    axis: Cia402Settings, servo: Servo, transmit: Transmit, *, is_lockstep: bool
) -> AmplifierNode:
    settings = cia402.Cia402Settings(
        rated_torque_Nm=axis.rated_torque_Nm, heartbeat_ms=axis.heartbeat_ms, serial=axis.node_id
    )
    return cia402.Cia402Node(axis.node_id, servo, transmit, settings, is_lockstep=is_lockstep)


def _mit(
    axis: MitSettings, servo: Servo, transmit: Transmit, *, is_lockstep: bool
) -> AmplifierNode:
    settings = MitNodeSettings(
        variant=axis.variant,
        node_id=axis.node_id,
        reply_id=axis.reply_id,
        ranges=axis.ranges,
        watchdog_ms=axis.watchdog_ms,
        is_lockstep=is_lockstep,
    )
    return make_node(settings, servo, transmit)


def _odrive(
    axis: OdriveSettings, servo: Servo, transmit: Transmit, *, is_lockstep: bool
) -> AmplifierNode:
    settings = OdriveNodeSettings(gear_ratio=axis.gear_ratio)
    path = axis.endpoints_file
    table = EMULATED if path is None else load_endpoints(path)
    node_id = axis.node_id
    return OdriveNode(node_id, servo, transmit, settings, table=table, is_lockstep=is_lockstep)


def _moteus(
    axis: MoteusSettings, servo: Servo, transmit: Transmit, *, is_lockstep: bool
) -> AmplifierNode:
    settings = MoteusNodeSettings(can_prefix=axis.can_prefix, serial=axis.node_id)
    return MoteusNode(axis.node_id, servo, transmit, settings, is_lockstep=is_lockstep)


_NODES: dict[str, Callable[..., AmplifierNode]] = {
    "cia402": _cia402,
    "mit": _mit,
    "moteus": _moteus,
    "odrive": _odrive,
}
"""Family -> what emulates one of its axes."""
