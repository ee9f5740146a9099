"""The emulator core with a small amplifier family of its own: torque in, position out on SYNC."""

import struct
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.frame import EFF_FLAG, ERR_FLAG, RTR_FLAG, pack_frame, unpack_frame
from sim_backend.arm import Arm
from sim_backend.emulator import Emulator
from sim_backend.errors import PlantError, SimError
from sim_backend.node import AmplifierNode
from sim_backend.perturbation import with_backlash
from sim_backend.presets import plant_preset, servo_preset
from sim_backend.servo import Servo
from sim_backend.settings import DisturbanceSettings, PayloadSettings, ServoSettings

SYNC = pack_frame(0x080)
ENABLE, DISABLE = pack_frame(0x100, b"\x01"), pack_frame(0x100, b"\x00")


class PlainNode(AmplifierNode):
    """Enable 0x100, torque 0x200 + id as a float; position 0x300 + id and a tick count out."""

    def __init__(self, servo, transmit, node_id):
        super().__init__(servo, transmit)
        self.node_id = node_id
        self.pending_Nm = 0.0
        self.ticks_s = []

    def power_on(self):
        self._transmit(pack_frame(0x700 + self.node_id, b"\x00"))

    def receive(self, can_id, data):
        if can_id == 0x080:
            self.servo.torque_target_Nm = self.pending_Nm
            feedback = struct.pack("<iI", self.servo.counts, len(self.ticks_s))
            self._transmit(pack_frame(0x300 + self.node_id, feedback))
        elif can_id == 0x100 and data:
            self.servo.is_energised = bool(data[0])
        elif can_id == 0x200 + self.node_id and len(data) == 4:
            (self.pending_Nm,) = struct.unpack("<f", data)

    def tick(self, dt_s):
        self.ticks_s.append(dt_s)


class Rig:
    """An emulated bench arm and what it has put on the wire."""

    def __init__(self, *, is_lockstep=True, **changes):
        self.sent = []
        settings = plant_preset("bench_v", (0.4, -0.5)).model_copy(update=changes)
        self.arm = Arm(settings)
        self.servos = [Servo(each) for each in servo_preset("bench")]
        self.nodes = [PlainNode(s, self.sent.append, i) for i, s in enumerate(self.servos, 1)]
        self.emulator = Emulator(self.arm, self.servos, self.nodes, is_lockstep=is_lockstep)

    def command(self, *tau_Nm):
        for node_id, tau in enumerate(tau_Nm, 1):
            self.emulator.receive(pack_frame(0x200 + node_id, struct.pack("<f", tau)))

    def feedback(self):
        """Take the frames sent since the last call, as {identifier: (counts, ticks)}."""
        frames = [unpack_frame(frame) for frame in self.sent]
        self.sent.clear()
        return {can_id: struct.unpack("<iI", data) for can_id, data in frames}

    def state(self):
        return self.emulator.time_ns, self.arm.q_rad, self.arm.dq_rad_s, self.sent[:]


def counts(q_rad):
    return round(q_rad * 4096 / (2.0 * pi)) % 4096


def test_emulator__power_on__every_node_announces_itself():
    rig = Rig()
    rig.emulator.power_on()
    assert rig.sent == [pack_frame(0x701, b"\x00"), pack_frame(0x702, b"\x00")]


def test_lockstep__sync__feedback_is_of_the_instant_before_the_plant_advanced():
    rig = Rig()
    rig.emulator.receive(ENABLE)
    rig.emulator.receive(SYNC)
    assert rig.feedback() == {0x301: (counts(0.4), 0), 0x302: (counts(-0.5), 0)}
    assert rig.emulator.q_true_rad == [0.4, -0.5]
    assert rig.emulator.time_ns == 1_000_000
    for _ in range(199):
        rig.emulator.receive(SYNC)
    before, latched = rig.arm.q_rad, rig.feedback()
    rig.emulator.receive(SYNC)
    assert rig.feedback() == {0x301: (counts(before[0]), 200), 0x302: (counts(before[1]), 200)}
    assert rig.emulator.q_true_rad == before != rig.arm.q_rad
    assert latched[0x301][0] != counts(0.4)  # the arm has fallen


def test_lockstep__torque_command__takes_effect_at_the_next_sync_and_not_before():
    rig = Rig(gravity_m_s2=0.0)
    rig.emulator.receive(ENABLE)
    rig.emulator.receive(SYNC)
    rig.command(2.0, 0.0)
    assert rig.emulator.tau_applied_Nm == pytest.approx([0.0, 0.0], abs=1e-9)
    assert rig.arm.dq_rad_s == pytest.approx([0.0, 0.0], abs=1e-9)
    rig.emulator.receive(SYNC)
    # The current loop's first two periods: 250 Hz, seen through the winding's 3 ms.
    assert 0.3 * 2.0 < rig.emulator.tau_applied_Nm[0] < 0.8 * 2.0
    assert rig.emulator.dq_true_rad_s == pytest.approx([0.0, 0.0], abs=1e-9)
    rig.emulator.receive(SYNC)
    assert rig.emulator.dq_true_rad_s[0] > 0.0


def test_lockstep__torque_applied__explains_the_motion():
    rig = Rig(gravity_m_s2=0.0)
    link_1, link_2 = rig.arm.settings.links
    slick = {"viscous_Nms_rad": 0.0, "coulomb_Nm": 0.0}
    links = (link_1.model_copy(update=slick), link_2.model_copy(update=slick))
    rig = Rig(gravity_m_s2=0.0, links=links)
    rig.emulator.receive(ENABLE)
    work_J = 0.0
    for k in range(300):
        rig.command(0.5 if k % 40 < 20 else -0.3, 0.2)
        before = rig.arm.q_rad
        rig.emulator.receive(SYNC)
        moved = [now - then for now, then in zip(rig.arm.q_rad, before, strict=True)]
        work_J += sum(t * d for t, d in zip(rig.emulator.tau_applied_Nm, moved, strict=True))
    assert rig.arm.energy_J() > 0.05
    assert work_J == pytest.approx(rig.arm.energy_J(), rel=2e-2)


def test_lockstep__same_frames__same_bits():
    first, second = Rig(), Rig()
    for rig in (first, second):
        rig.emulator.receive(ENABLE)
        for k in range(300):
            rig.command(1.0 - 0.01 * k, 0.3)
            rig.emulator.receive(SYNC)
    assert first.state() == second.state()
    assert first.emulator.tau_applied_Nm == second.emulator.tau_applied_Nm


def test_wall__sync__latches_and_answers_but_time_is_the_callers():
    rig = Rig(is_lockstep=False)
    rig.emulator.receive(SYNC)
    assert len(rig.feedback()) == 2
    assert rig.emulator.time_ns == 0
    rig.emulator.is_lockstep = True
    rig.emulator.receive(SYNC)
    assert rig.emulator.time_ns == 1_000_000


def test_advance__any_slices__whole_current_loop_periods_and_one_tick_per_ms():
    rig = Rig(is_lockstep=False, is_held_until_enabled=False)
    for slice_ns in (499_999, 1, 700_000, 0, 300_000, 3_249_999):
        rig.emulator.advance(slice_ns)
    assert rig.emulator.time_ns == 4_500_000  # of 4 749 999
    assert rig.nodes[0].ticks_s == [1e-3] * 4
    rig.emulator.advance(250_001)
    assert rig.emulator.time_ns == 5_000_000
    assert rig.nodes[1].ticks_s == [1e-3] * 5


@given(slices_ns=st.lists(st.integers(0, 3_000_000), max_size=20))
def test_advance__any_slices__same_bits_as_in_one_piece(slices_ns):
    sliced, whole = Rig(is_held_until_enabled=False), Rig(is_held_until_enabled=False)
    for slice_ns in slices_ns:
        sliced.emulator.advance(slice_ns)
    whole.emulator.advance(sum(slices_ns))
    assert sliced.state() == whole.state()
    assert sliced.nodes[0].ticks_s == whole.nodes[0].ticks_s


def test_advance__backwards__sim_error():
    with pytest.raises(SimError, match="backwards"):
        Rig().emulator.advance(-1)


def test_held_arm__first_servo_energised__is_released_for_good():
    rig = Rig()
    for _ in range(50):
        rig.emulator.receive(SYNC)
    assert rig.arm.q_rad == [0.4, -0.5]
    assert rig.arm.is_held
    rig.emulator.receive(ENABLE)
    rig.emulator.receive(SYNC)
    rig.emulator.receive(DISABLE)
    for _ in range(50):
        rig.emulator.receive(SYNC)
    assert not rig.arm.is_held
    assert rig.arm.q_rad[0] < 0.39  # a limp arm falls
    assert rig.emulator.time_ns == 101_000_000


def test_arm_not_to_be_held__falls_from_the_start():
    rig = Rig(is_held_until_enabled=False)
    for _ in range(50):
        rig.emulator.receive(SYNC)
    assert rig.arm.q_rad[0] < 0.39


def backlash(encoder):
    return with_backlash(plant_preset("bench_h", (0.4, -0.5)), 0.04, encoder).links


@pytest.mark.parametrize("encoder", ["motor", "link"])
def test_drivetrain__rotor_moves_in_its_gap__encoder_reads_its_side_and_truth_is_the_link(encoder):
    rig = Rig(gravity_m_s2=0.0, links=backlash(encoder))
    rig.emulator.receive(ENABLE)
    rig.command(0.5, 0.0)
    for _ in range(13):
        rig.emulator.receive(SYNC)
    at_encoder, q_motor_rad, rate = rig.servos[0].q_rad, rig.arm.q_motor_rad[0], rig.arm.dq_rad_s[0]
    assert rig.emulator.q_true_rad == pytest.approx([0.4, -0.5], abs=1e-9)
    assert q_motor_rad > 0.405
    assert at_encoder == (q_motor_rad if encoder == "motor" else rig.arm.q_rad[0])
    assert rig.servos[0].motor_rad_s == rig.arm.dq_motor_rad_s[0] > 0.5
    assert rig.servos[0].dq_rad_s == (rig.servos[0].motor_rad_s if encoder == "motor" else rate)
    for _ in range(60):
        rig.emulator.receive(SYNC)
    assert rig.emulator.q_true_rad[0] > 0.41
    assert abs(rig.emulator.q_true_rad[0] - rig.arm.q_motor_rad[0]) > 1e-3


def test_emulator__plant_by_call__payload_and_disturbance_reach_it():
    rig, idle = Rig(), Rig()
    rig.emulator.arm.pick_up(PayloadSettings(mass_kg=0.4))
    rig.emulator.arm.disturb((0.0, 0.2))
    for each in (rig, idle):
        each.emulator.receive(ENABLE)
        for _ in range(100):
            each.emulator.receive(SYNC)
    assert rig.emulator.q_true_rad != pytest.approx(idle.emulator.q_true_rad, abs=1e-3)


def test_held_arm__schedule__begins_when_the_arm_is_let_go():
    step = DisturbanceSettings(joint=1, torque_Nm=0.5, start_s=0.02)
    rig = Rig(gravity_m_s2=0.0, disturbances=(step,))
    for _ in range(100):
        rig.emulator.receive(SYNC)
    rig.emulator.receive(ENABLE)
    rig.command(0.0, 0.0)
    for _ in range(20):
        rig.emulator.receive(SYNC)
    assert rig.arm.q_rad == pytest.approx([0.4, -0.5], abs=1e-9)
    for _ in range(30):
        rig.emulator.receive(SYNC)
    assert rig.arm.q_rad[0] > 0.401


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        SYNC[:15],
        SYNC + b"\x00" * 56,  # CAN FD
        pack_frame(0x080 | RTR_FLAG),
        pack_frame(0x080 | ERR_FLAG),
        pack_frame(0x080 | EFF_FLAG),
        pack_frame(0x7FF, b"garbage!"),
    ],
)
def test_receive__not_a_sync__nothing_advances(frame):
    rig = Rig()
    before = rig.state()
    rig.emulator.receive(frame)
    assert rig.state() == before


@given(frame=st.binary(max_size=80) | st.binary(min_size=16, max_size=16))
def test_receive__any_bytes__never_raises(frame):
    Rig().emulator.receive(frame)


def test_receive__length_byte_above_8__read_as_8():
    rig = Rig()
    broken = bytearray(pack_frame(0x080, b"\x00" * 8))
    broken[4] = 255
    rig.emulator.receive(bytes(broken))
    assert rig.emulator.time_ns == 1_000_000


def test_receive__torque_nan__no_torque_and_nothing_raised():
    rig, idle = Rig(), Rig()
    rig.command(float("nan"), float("nan"))
    for each in (rig, idle):
        each.emulator.receive(ENABLE)
        for _ in range(20):
            each.emulator.receive(SYNC)
    assert rig.state() == idle.state()


def test_receive__arm_torn_apart__plant_error():
    rig = Rig()
    absurd = ServoSettings(torque_constant_Nm_A=1.0, current_max_A=1e9, supply_V=1e9)
    servos = [Servo(absurd), Servo(absurd)]
    nodes = [PlainNode(servo, rig.sent.append, i) for i, servo in enumerate(servos, 1)]
    rig.emulator = Emulator(rig.arm, servos, nodes, is_lockstep=True)
    rig.emulator.receive(ENABLE)
    rig.command(1e8, -1e8)
    with pytest.raises(PlantError, match="came apart"):
        rig.emulator.receive(SYNC)


def test_emulator__servos_or_nodes_missing__sim_error():
    rig = Rig()
    with pytest.raises(SimError, match="2 joints needs 2 servos and nodes: got 1 and 2"):
        Emulator(rig.arm, rig.servos[:1], rig.nodes, is_lockstep=True)
    with pytest.raises(SimError, match="got 2 and 0"):
        Emulator(rig.arm, rig.servos, [], is_lockstep=True)
