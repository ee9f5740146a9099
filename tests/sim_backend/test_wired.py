"""Amplifiers and plant on the wire in virtual time: what arrives when, and what it does."""

import struct

import pytest

from drivers.frame import pack_frame, unpack_frame
from sim_backend.arm import Arm
from sim_backend.can_controller import CLASS_BUS_OFF, CLASS_RESTARTED
from sim_backend.emulator import Emulator
from sim_backend.node import AmplifierNode
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.servo import Servo
from sim_backend.settings import WireSettings
from sim_backend.wire_bits import frame_bits
from sim_backend.wired import VirtualWire

US = 1000
PERIOD_NS = 1_000_000
SYNC = pack_frame(0x080)


class EchoNode(AmplifierNode):
    """Takes a number with 0x200 + id; tells the last one before each SYNC with 0x180 + id."""

    def __init__(self, servo, transmit, node_id):
        super().__init__(servo, transmit)
        self.node_id = node_id
        self.number = 0
        self.periods = self.ticks = 0

    def power_on(self):
        self._transmit(pack_frame(0x700 + self.node_id, b"\x00"))

    def receive(self, can_id, data):
        if can_id == 0x080:
            self._transmit(pack_frame(0x180 + self.node_id, struct.pack("<Q", self.number)))
        elif can_id == 0x200 + self.node_id and len(data) == 4:
            (self.number,) = struct.unpack("<I", data)

    def tick(self, dt_s):
        assert dt_s == 1e-3
        self.ticks += 1

    def begin_period(self):
        self.periods += 1


class Rig:
    """A bench arm with two echoing amplifiers, and a host that notes what it gets.

    Attributes:
        heard: (microseconds, identifier, data) at the host.
    """

    def __init__(self, *, bit_rate=1_000_000, **setting):
        self.heard = []
        self.wire = VirtualWire(
            WireSettings(is_on=True, **setting),
            self.note,
            joints=2,
            bit_rate=bit_rate,
            data_bit_rate=5_000_000,
        )
        servos = [Servo(each) for each in servo_preset("bench")]
        plain = zip(servos, self.wire.ports, (1, 2), strict=True)
        self.nodes = [EchoNode(servo, port.send, number) for servo, port, number in plain]
        attached = [p.attach(n) for p, n in zip(self.wire.ports, self.nodes, strict=True)]
        arm = Arm(plant_preset("bench_v", (0.4, -0.5)))
        self.emulator = Emulator(arm, servos, attached, is_lockstep=False)
        self.wire.connect(self.emulator)

    def note(self, frame):
        self.heard.append((self.wire.model.now_ns / US, *unpack_frame(frame)))

    def numbers(self):
        """What the amplifiers said, by cycle: {identifier: [number, ...]}."""
        said = {0x181: [], 0x182: []}
        for _, can_id, data in self.heard:
            if can_id in said:
                said[can_id].append(struct.unpack("<Q", data)[0])
        return said


def command(node_id, number):
    return pack_frame(0x200 + node_id, struct.pack("<I", number))


def test_virtual_wire__sync_and_answers__arrive_after_wait_and_duration():
    rig = Rig()
    rig.wire.send(SYNC)
    rig.wire.advance(PERIOD_NS)
    answer = pack_frame(0x181, bytes(8))
    sync_us = frame_bits(SYNC)
    (first_us, first_id, _), (second_us, second_id, _) = rig.heard
    assert (first_id, second_id) == (0x181, 0x182)
    assert first_us == sync_us + frame_bits(answer) - 3
    assert second_us == first_us + frame_bits(pack_frame(0x182, bytes(8)))


def test_virtual_wire__stops_at_host__at_each_arrival_and_at_the_limit():
    rig = Rig()
    rig.wire.send(SYNC)
    instants = []
    while (reached_ns := rig.wire.advance(PERIOD_NS, stops_at_host=True)) < PERIOD_NS:
        instants.append(reached_ns / US)
    assert instants == [us for us, _, _ in rig.heard]
    assert len(instants) == 2
    assert reached_ns == PERIOD_NS == rig.wire.model.now_ns


def test_virtual_wire__time_passes__plant_and_nodes_follow_it():
    rig = Rig()
    rig.wire.advance(10 * PERIOD_NS + 499 * US)
    assert rig.emulator.time_ns == 10 * PERIOD_NS
    assert [node.ticks for node in rig.nodes] == [10, 10]
    assert [node.periods for node in rig.nodes] == [10, 10]


def test_virtual_wire__amplifiers__announce_themselves_in_order_of_identifiers():
    rig = Rig()
    rig.emulator.power_on()
    rig.wire.advance(PERIOD_NS)
    assert [can_id for _, can_id, _ in rig.heard] == [0x701, 0x702]


@pytest.mark.parametrize(
    ("sent_at_us", "expected"),
    [
        (500, [[0, 1, 2, 3], [0, 1, 2, 3]]),  # both reach their drives before the next SYNC
        (950, [[0, 1, 2, 3], [0, 0, 1, 2]]),  # SYNC goes before the second: a period later
        (999, [[0, 1, 2, 3], [0, 0, 1, 2]]),  # the first has begun and cannot be stopped
    ],
)
def test_virtual_wire__command_sent_late__takes_effect_one_period_later(sent_at_us, expected):
    rig = Rig()
    for cycle in range(4):
        rig.wire.send(SYNC)
        rig.wire.advance(cycle * PERIOD_NS + sent_at_us * US)
        rig.wire.send(command(1, cycle + 1))
        rig.wire.send(command(2, cycle + 1))
        rig.wire.advance((cycle + 1) * PERIOD_NS)
    assert list(rig.numbers().values()) == expected


def test_virtual_wire__node_bus_off__deaf_and_dumb_until_it_recovers():
    rig = Rig()
    controller = rig.wire.ports[0].controller
    rig.wire.model.force_bus_off(controller)
    rig.wire.send(command(1, 7))
    rig.wire.send(SYNC)
    rig.wire.advance(PERIOD_NS)
    assert rig.numbers() == {0x181: [], 0x182: [0]}
    assert rig.nodes[0].number == 0
    assert rig.nodes[0].ticks == 1  # it lives; only its controller is off
    rig.wire.advance(3 * PERIOD_NS)
    assert not controller.is_bus_off
    rig.wire.send(command(1, 7))
    rig.wire.advance(3 * PERIOD_NS + 500 * US)
    rig.wire.send(SYNC)
    rig.wire.advance(4 * PERIOD_NS)
    assert rig.numbers() == {0x181: [7], 0x182: [0, 0]}


def test_virtual_wire__host_bus_off__hears_only_its_own_controller():
    rig = Rig()
    rig.wire.model.force_bus_off(rig.wire.host)
    rig.wire.send(SYNC)
    rig.emulator.power_on()
    rig.wire.advance(4 * PERIOD_NS)
    classes = [can_id & 0x1FF for _, can_id, _ in rig.heard]
    assert classes == [CLASS_BUS_OFF, CLASS_RESTARTED]
    rig.wire.send(SYNC)
    rig.wire.advance(5 * PERIOD_NS)
    assert len(rig.numbers()[0x181]) == 1


def test_virtual_wire__same_seed__same_instants_with_bit_errors():
    def run(seed):
        rig = Rig(bit_error_rate=2e-3, seed=seed)
        for cycle in range(50):
            rig.wire.send(SYNC)
            rig.wire.advance((cycle + 1) * PERIOD_NS)
        assert rig.wire.model.total.errors > 0
        return rig.heard

    assert run(1) == run(1)
    assert run(1) != run(2)
