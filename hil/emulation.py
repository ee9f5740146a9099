"""Builds the emulated robot that a configuration describes."""

from collections.abc import Callable

from drivers.cia402.settings import Cia402Settings
from hil.config import Config
from sim_backend.arm import Arm
from sim_backend.cia402 import node as cia402
from sim_backend.emulator import Emulator
from sim_backend.node import AmplifierNode, Transmit
from sim_backend.servo import Servo


def build_emulator(config: Config, transmit: Transmit, *, is_lockstep: bool) -> Emulator:
    """Return the arm of `config.plant` behind one emulated amplifier per entry of `config.axes`.

    Args:
        config: Plant, motors, and the axes whose families and identifiers are to be emulated.
        transmit: Puts a frame on the wire.
        is_lockstep: What the amplifiers tell the master about their time, and how time begins.

    Raises:
        SimError: If the plant cannot be built as configured.
    """
    servos = [Servo(settings) for settings in config.servos]
    nodes = [
        _NODES[axis.family](axis, servo, transmit, is_lockstep=is_lockstep)
        for axis, servo in zip(config.axes, servos, strict=True)
    ]
    return Emulator(Arm(config.plant), servos, nodes, is_lockstep=is_lockstep)


def _cia402(
    axis: Cia402Settings, servo: Servo, transmit: Transmit, *, is_lockstep: bool
) -> AmplifierNode:
    settings = cia402.Cia402Settings(
        rated_torque_Nm=axis.rated_torque_Nm, heartbeat_ms=axis.heartbeat_ms, serial=axis.node_id
    )
    return cia402.Cia402Node(axis.node_id, servo, transmit, settings, is_lockstep=is_lockstep)


_NODES: dict[str, Callable[..., AmplifierNode]] = {
    "cia402": _cia402,
}
"""Family -> what emulates one of its axes."""
