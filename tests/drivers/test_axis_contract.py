"""What every amplifier family promises, master and emulated amplifier together.

A family adds its cases to `CASES`; the rest is the same for all.
"""

import random
from dataclasses import dataclass, field

import pytest

from drivers.axis import AxisStatus
from drivers.errors import AmplifierError
from drivers.frame import EFF_FLAG, pack_frame, unpack_header
from drivers.registry import SETTINGS
from tests.drivers.axis_rig import AxisRig, keep, lose

SEED = 20240722


@dataclass(frozen=True)
class Case:
    """One way to use a family.

    Attributes:
        family: Its name in the registry.
        changes: Settings of both joints besides the family's defaults.
        watchdog: The setting with the amplifier's command watchdog in ms.
        tells_enabled: An amplifier says whether it is enabled.
        tells_faults: An amplifier says that it has a fault.
        fault_cycles: So many cycles after a fault, at most, the amplifier has told of it.
        drops_power: The watchdog switches power off (else it takes the torque to zero).
    """

    family: str
    watchdog: str
    changes: dict = field(default_factory=dict)
    tells_enabled: bool = True
    tells_faults: bool = True
    drops_power: bool = True
    fault_cycles: int = 3


def _mini_cheetah(variant, **more):
    changes = {"variant": variant, "is_lockstep": True}
    return Case("mit", "watchdog_ms", changes, tells_enabled=False, drops_power=False, **more)


def _odrive(**changes):
    changes |= {"heartbeat_ms": 20, "torque_report_ms": 10}  # what it tells comes with these
    return Case("odrive", "watchdog_ms", changes, fault_cycles=21)


CASES = {
    "cia402": Case("cia402", "rpdo_timeout_ms"),
    "mit damiao": Case("mit", "watchdog_ms"),
    "mit tmotor": _mini_cheetah("tmotor", tells_faults=False),
    "mit cubemars": _mini_cheetah("cubemars"),
    "mit cybergear": Case("mit", "watchdog_ms", {"variant": "cybergear"}),
    "mit robstride": Case("mit", "watchdog_ms", {"variant": "robstride"}),
    "moteus": Case("moteus", "watchdog_ms"),
    "moteus prefix": Case("moteus", "watchdog_ms", {"can_prefix": 5}),
    "odrive poll": _odrive(),
    "odrive cyclic": _odrive(feedback="cyclic"),
    "odrive geared": _odrive(gear_ratio=9.0),
}


@pytest.fixture(params=CASES.values(), ids=CASES.keys())
def case(request):
    return request.param


@pytest.fixture
def rig(case):
    return AxisRig(case.family, (case.changes, case.changes)).configure()


def test_families__all_of_the_registry__have_a_case():
    assert {case.family for case in CASES.values()} == set(SETTINGS)


def test_configure__fresh_drive__disabled_with_feedback_in_every_cycle(rig):
    assert rig.all_are("DISABLED")
    assert all(rig.cycle() for _ in range(20))
    assert not any(servo.is_energised for servo in rig.servos)
    for axis, info, servo in zip(rig.axes, rig.infos, rig.servos, strict=True):
        assert info.is_lockstep
        assert info.name
        step_rad = info.angle_resolution_rad + 2 * 3.1416 / servo.counts_per_turn
        assert axis.q_rad == pytest.approx(servo.q_rad, abs=step_rad)
        assert 0.0 < info.torque_resolution_Nm < 0.05


def test_configure__drive_enabled_by_another_master__refused(case):
    if not case.tells_enabled:
        pytest.skip(f"{case.changes['variant']} does not tell whether it is enabled")
    changes = case.changes | {case.watchdog: 200}
    rig = AxisRig(case.family, (changes, changes)).configure().enable()
    rig.infos = []  # the other master falls silent, and time passes while the new one waits
    with pytest.raises(AmplifierError, match="already enabled"):
        rig.new_master().configure(heartbeat_cycles=0)


def test_configure__drive_absent__one_line_that_names_the_axis(case):
    rig = AxisRig(case.family, (case.changes, case.changes))
    rig.to_drives = lose
    with pytest.raises(AmplifierError) as caught:
        rig.configure()
    assert "joint 1" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_enable__disabled__power_without_torque(rig):
    took = rig.enable().until(lambda: all(servo.is_energised for servo in rig.servos))
    assert took <= 2
    rig.cycles(3)
    for target_Nm, info in zip(rig.targets_Nm, rig.infos, strict=True):
        assert abs(target_Nm) <= info.torque_resolution_Nm / 2 * 1.001


@pytest.mark.parametrize("direction", [1, -1])
def test_torque__either_direction__turns_the_joint_and_is_measured_with_its_sign(case, direction):
    changes = case.changes | {"direction": direction, "offset_rad": 0.3}
    rig = AxisRig(case.family, (changes, changes)).configure().enable()
    rig.cycles(15, 1.0, -0.5)
    for target_Nm, wanted_Nm, info in zip(rig.targets_Nm, (1.0, -0.5), rig.infos, strict=True):
        assert target_Nm == pytest.approx(direction * wanted_Nm, abs=info.torque_resolution_Nm)
    for axis, servo, wanted_Nm in zip(rig.axes, rig.servos, (1.0, -0.5), strict=True):
        assert axis.tau_meas_Nm == pytest.approx(wanted_Nm, abs=0.05)
        assert axis.q_rad == pytest.approx(direction * servo.q_rad + 0.3, abs=0.01)


@pytest.mark.parametrize("asked_Nm", [1e3, -1e3, 1e300, float("inf")])
def test_torque__beyond_the_maximum__clipped_and_never_wrapped(case, asked_Nm):
    if case.family == "cia402" and asked_Nm == float("inf"):
        pytest.skip("the loop never sends a torque that is not finite")
    changes = case.changes | {"torque_max_Nm": 3.0}
    rig = AxisRig(case.family, (changes, changes)).configure().enable()
    rig.cycles(3, asked_Nm, -asked_Nm)
    for target_Nm, sign, info in zip(rig.targets_Nm, (1, -1), rig.infos, strict=True):
        wanted_Nm = sign * (3.0 if asked_Nm > 0 else -3.0)
        assert abs(target_Nm) <= 3.0 + info.torque_resolution_Nm / 2
        assert target_Nm == pytest.approx(wanted_Nm, abs=0.02)


def test_torque__every_step_between_the_limits__monotonic_and_within_half_a_step(rig):
    rig.enable()
    rig.cycles(2)
    resolution_Nm = rig.infos[0].torque_resolution_Nm
    before_Nm = -1e9
    for step in range(-30, 31):
        tau_Nm = step * resolution_Nm / 3
        rig.cycles(2, tau_Nm, 0.0)
        target_Nm = rig.targets_Nm[0]
        assert abs(target_Nm - tau_Nm) <= resolution_Nm / 2 * 1.001
        assert target_Nm >= before_Nm
        before_Nm = target_Nm


def test_disable__under_torque__power_off_at_the_next_cycle(rig):
    rig.enable().cycles(3, 1.0, 1.0)
    for axis in rig.axes:
        axis.disable()
    rig.cycles(2, 1.0, 1.0)
    assert not any(servo.is_energised for servo in rig.servos)
    rig.cycles(3, 1.0, 1.0)
    assert rig.all_are("DISABLED")
    assert rig.targets_Nm == [0.0, 0.0]


def test_enable__again_after_disable_under_torque__old_torque_does_not_come_back(rig):
    rig.enable().cycles(3, 1.0, 1.0)
    for axis in rig.axes:
        axis.disable()
    rig.cycles(5)
    for axis in rig.axes:
        axis.enable()
    for _ in range(20):
        rig.cycle()
        for target_Nm, info in zip(rig.targets_Nm, rig.infos, strict=True):
            assert abs(target_Nm) <= info.torque_resolution_Nm / 2 * 1.001


def test_loss_of_command__under_torque__torque_off_within_the_watchdog(case, rig):
    rig.enable().cycles(3, 1.0, 1.0)
    rig.to_drives = lose
    limit_ms = getattr(rig.settings[0], case.watchdog)
    torques = []
    for _ in range(limit_ms + 2):
        rig.cycle(1.0, 1.0)
        torques.append(rig.targets_Nm)
    if case.drops_power:
        assert not any(servo.is_energised for servo in rig.servos)
    assert torques[-1] == [0.0, 0.0]
    assert max(map(abs, torques[limit_ms // 2])) > 0.9, "it let go too early"


def test_fault__in_operation__power_off_noted_and_reset(case, rig):
    frame = rig.axes[0].inject_fault()
    if not case.tells_faults:
        assert frame is None
        pytest.skip(f"{case.changes['variant']} has no way to tell a fault")
    rig.enable().cycles(3, 1.0, 1.0)
    rig.emulator.receive(frame)
    rig.cycles(case.fault_cycles, 1.0, 1.0)
    axis = rig.axes[0]
    assert axis.status is AxisStatus.FAULT
    assert axis.label in axis.note
    assert "\n" not in axis.note
    assert rig.targets_Nm[0] == 0.0
    assert rig.axes[1].status is AxisStatus.ENABLED
    axis.enable()
    rig.cycles(20)
    assert axis.status is AxisStatus.FAULT, "only a reset ends a fault"
    axis.reset_fault()
    rig.cycles(30)
    assert axis.status is AxisStatus.DISABLED
    assert not axis.note
    axis.enable()
    rig.until(lambda: rig.bus.is_enabled)


def test_silence__drive_gone__lost_with_a_note_and_back_disabled(rig):
    rig.enable()
    rig.to_master = lambda frame: []
    rig.until(lambda: rig.all_are("LOST"))
    assert all(axis.label in axis.note for axis in rig.axes)
    assert rig.bus.age_cycles > 1
    rig.to_master = keep
    rig.cycles(300)
    assert not rig.bus.is_enabled
    for axis in rig.axes:
        axis.reset_fault()
    rig.cycles(200)
    assert rig.all_are("DISABLED")
    rig.enable()


def test_garbage__random_frames_to_both_sides__no_exception_and_torque_within_limits(rig):
    rig.enable()
    chance = random.Random(SEED)
    known = [identifier for axis in rig.axes for identifier in list(axis.handlers())[:4]]
    for _ in range(300):
        for _ in range(4):
            can_id = chance.choice(
                [*known, chance.getrandbits(11), EFF_FLAG | chance.getrandbits(29)]
            )
            frame = pack_frame(can_id, chance.randbytes(chance.randrange(9)))
            rig.loopback.deliver(frame)
            if unpack_header(frame)[0] != 0x080:
                rig.emulator.receive(frame)
        rig.cycle(1.0, -1.0)
        for servo, axis in zip(rig.servos, rig.axes, strict=True):
            assert abs(servo.torque_target_Nm) <= servo.torque_max_Nm * (1 + 1e-9)
            assert isinstance(axis.status, AxisStatus)
            assert axis.q_rad == axis.q_rad
