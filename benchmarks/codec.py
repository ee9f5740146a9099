"""What frames cost in one cycle of two axes, against python-can messages and `struct`.

The cycle: SYNC, two TPDO1 taken (statusword, position, torque, in SI), two RPDO1 made. The
reference does no more than it has to: one `can.Message` a frame, its data packed or unpacked.
Neither side touches a bus; the reference's messages are made from the records a socket gives.
"""

import struct
from collections.abc import Callable

import can

from benchmarks import rig
from benchmarks.measure import (
    Samples,
    Target,
    alternate,
    median,
    percentile,
    ratio,
    row,
    times,
    title,
    us,
)
from benchmarks.sim import capture_cycle
from drivers.arm_bus import ArmBus
from drivers.axis import Axis
from drivers.frame import pack_frame, unpack_frame, unpack_header

TURNS, CALLS = 50, 500
RECORD = struct.Struct("=IB3x8s")
TPDO1, RPDO1 = struct.Struct("<Hih"), struct.Struct("<Hh")
NODES = (1, 2)
RAD_PER_COUNT, NM_PER_MILLE = 6.283185307179586 / 4096, 5e-3


def run(scale: float) -> list[Target]:
    title("codec", "frames of one cycle: SYNC, 2 TPDO1 taken, 2 RPDO1 made; no bus")
    row("", "ours p50", "ours p99", "can p50", "can p99", "can/ours")
    received, _ = capture_cycle(rig.tracking_simulation(rig.configuration()))
    turns = round(TURNS * scale) + 2
    whole = alternate({"ours": _ours(received), "can": _plain(received)}, turns=turns, calls=CALLS)
    _print("whole cycle", whole)
    record = received[0]
    _print("one record taken apart", alternate(_unpackers(record), turns=turns, calls=CALLS))
    _print("one record made", alternate(_packers(), turns=turns, calls=CALLS))
    return []


def _print(label: str, samples: Samples) -> None:
    cells = []
    for name in ("ours", "can"):
        cells += [us(median(samples[name])), us(percentile(samples[name], 0.99))]
    row(label, *cells, times(ratio(samples, "can", "ours")))


def _ours(received: list[bytes]) -> Callable[[], object]:
    """Take and make frames as `ArmBus` does, with the axes of a tracking arm."""
    simulation = rig.tracking_simulation(rig.configuration())
    arm: ArmBus = simulation.control._bus  # type: ignore[assignment]
    axes: list[Axis] = arm.axes
    handlers = arm._handlers
    first, second = received

    def body() -> None:
        for axis in axes:
            axis.age_cycles += 1
        for frame in (first, second):
            handler = handlers.get(unpack_header(frame)[0])
            if handler is not None:
                handler(frame)
        for axis in axes:
            axis.command(0.3)

    return body


def _plain(received: list[bytes]) -> Callable[[], object]:
    """The same by hand on python-can: dispatch by identifier, scaling, one message a frame."""
    state: dict[int, tuple[int, float, float]] = {}
    first, second = received

    def receive(record: bytes) -> None:
        message = _message(record)
        statusword, position, torque = TPDO1.unpack(message.data)
        node = message.arbitration_id - 0x180
        state[node] = (statusword, position * RAD_PER_COUNT, torque * NM_PER_MILLE)

    def send(node: int, tau_Nm: float) -> None:
        data = RPDO1.pack(0x0F, round(tau_Nm / NM_PER_MILLE))
        can.Message(arbitration_id=0x200 + node, data=data, is_extended_id=False)

    def body() -> None:
        can.Message(arbitration_id=0x080, is_extended_id=False)
        receive(first)
        receive(second)
        for node in NODES:
            send(node, 0.3)

    return body


def _message(record: bytes) -> can.Message:
    can_id, length, data = RECORD.unpack(record)
    return can.Message(arbitration_id=can_id, data=data[:length], dlc=length, is_extended_id=False)


def _unpackers(record: bytes) -> dict[str, Callable[[], object]]:
    return {"ours": lambda: unpack_frame(record), "can": lambda: _message(record)}


def _packers() -> dict[str, Callable[[], object]]:
    data = bytes(4)
    return {
        "ours": lambda: pack_frame(0x201, data),
        "can": lambda: can.Message(arbitration_id=0x201, data=data, is_extended_id=False),
    }
