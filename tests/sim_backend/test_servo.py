"""The servo axis: winding, current loop, limits, encoder."""

import math
from math import exp, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backend.servo import CURRENT_LOOP_PERIOD_S, Servo
from sim_backend.settings import ServoSettings

SETTINGS = ServoSettings(torque_constant_Nm_A=1.5)


def energised(target_Nm: float, settings: ServoSettings = SETTINGS) -> Servo:
    servo = Servo(settings)
    servo.is_energised = True
    servo.torque_target_Nm = target_Nm
    return servo


def test_servo__torque_step_at_standstill__one_pole_at_the_bandwidth():
    servo = energised(3.0)
    pole = exp(-2.0 * pi * 250.0 * 500e-6)
    for k in range(1, 20):
        servo.drive()
        assert servo.torque_Nm == pytest.approx(3.0 * (1.0 - pole**k), abs=1e-12)
    assert not servo.is_saturated


@pytest.mark.parametrize("dq_rad_s", [-8.0, 5.0])
def test_servo__constant_rate__back_emf_is_overcome(dq_rad_s):
    servo = energised(3.0)
    servo.sense(0.0, dq_rad_s)
    for _ in range(100):  # a disturbance decays with the winding's 3 ms
        mean_Nm = servo.drive()
    assert mean_Nm == pytest.approx(3.0, abs=1e-6)
    assert servo.torque_Nm == pytest.approx(3.0, abs=1e-6)


def test_servo__encoder_on_the_link__back_emf_is_of_the_rotor():
    on_link, on_motor = energised(3.0), energised(3.0)
    on_link.sense(0.1, 0.0, 6.0)
    on_motor.sense(0.2, 6.0)
    assert (on_link.dq_rad_s, on_link.motor_rad_s, on_motor.motor_rad_s) == (0.0, 6.0, 6.0)
    assert on_link.drive() == on_motor.drive() != energised(3.0).drive()
    assert on_link.counts != on_motor.counts


def test_servo__one_period__mean_torque_is_the_integral_of_the_winding_equation():
    servo = energised(4.0)
    servo.sense(0.0, 2.0)
    servo.drive()
    before_A = servo.current_A
    voltage_V = winding_voltage_V(servo)
    current_A, area_As, steps = before_A, 0.0, 20000
    h = CURRENT_LOOP_PERIOD_S / steps
    for _ in range(steps):  # L di/dt = v - R i - k dq, by the midpoint rule
        slope = (voltage_V - 2.0 * current_A - 1.5 * 2.0) / 6e-3
        middle_A = current_A + 0.5 * h * slope
        area_As += h * middle_A
        current_A += h * (voltage_V - 2.0 * middle_A - 1.5 * 2.0) / 6e-3
    mean_Nm = servo.drive()
    assert mean_Nm == pytest.approx(1.5 * area_As / CURRENT_LOOP_PERIOD_S, abs=1e-9)
    assert servo.current_A == pytest.approx(current_A, abs=1e-9)


def winding_voltage_V(servo: Servo) -> float:
    """Voltage the current loop is about to apply, from its textbook equations."""
    decay = exp(-CURRENT_LOOP_PERIOD_S * 2.0 / 6e-3)
    gain = (1.0 - exp(-2.0 * pi * 250.0 * CURRENT_LOOP_PERIOD_S)) * 2.0 / (1.0 - decay)
    first_error_A = 4.0 / 1.5  # the integral has seen the first period's error only
    return gain * (4.0 / 1.5 - servo.current_A) + gain * (1.0 - decay) * first_error_A


@pytest.mark.parametrize(("target_Nm", "limit_Nm"), [(20.0, 15.0), (-20.0, -15.0), (1e300, 15.0)])
def test_servo__target_above_the_peak__current_limited_and_reported(target_Nm, limit_Nm):
    servo = energised(target_Nm)
    for _ in range(100):
        mean_Nm = servo.drive()
    assert mean_Nm == pytest.approx(limit_Nm, rel=1e-6)
    assert servo.is_saturated
    assert servo.torque_max_Nm == 15.0


def test_servo__target_nan__no_torque_and_recovers():
    servo = energised(math.nan)
    assert [servo.drive() for _ in range(5)] == [0.0] * 5
    servo.torque_target_Nm = 3.0
    assert servo.drive() == energised(3.0).drive()


def test_servo__too_fast_for_the_supply__torque_drops_and_recovers_without_windup():
    servo = energised(6.0)
    servo.sense(0.0, 40.0)  # back-EMF 60 V against a supply of 48 V
    for _ in range(200):
        mean_Nm = servo.drive()
    assert servo.is_saturated
    assert mean_Nm == pytest.approx(1.5 * (48.0 - 60.0) / 2.0)
    servo.sense(0.0, 0.0)
    highest_Nm = max(servo.drive() for _ in range(100))
    assert not servo.is_saturated
    assert highest_Nm < 6.0 * 1.15
    assert servo.torque_Nm == pytest.approx(6.0, rel=1e-3)


def test_servo__power_stage_off__no_torque_and_a_clean_restart():
    servo = energised(3.0)
    fresh = [servo.drive() for _ in range(5)]
    servo.is_energised = False
    assert servo.drive() == 0.0
    assert servo.torque_Nm == 0.0
    servo.is_energised = True
    assert [servo.drive() for _ in range(5)] == fresh


@pytest.mark.parametrize(
    ("q_rad", "counts"),
    [
        (0.0, 0),
        (2.0 * pi / 4096.0, 1),
        (-2.0 * pi / 4096.0, 4095),
        (0.49 * 2.0 * pi / 4096.0, 0),
        (0.51 * 2.0 * pi / 4096.0, 1),
        (-0.49 * 2.0 * pi / 4096.0, 0),
        (pi, 2048),
        (2.0 * pi, 0),
        (-7.0 * pi, 2048),
    ],
)
def test_servo__angle__nearest_count_within_one_turn(q_rad, counts):
    servo = Servo(SETTINGS)
    servo.sense(q_rad, 0.0)
    assert servo.counts == counts


def test_servo__encoder_offset__is_the_count_at_angle_zero():
    servo = Servo(SETTINGS.model_copy(update={"encoder_offset_counts": -100}))
    assert servo.counts == 3996
    servo.sense(101 * 2.0 * pi / 4096.0, 0.0)
    assert servo.counts == 1


@given(
    q_rad=st.floats(-1e4, 1e4),
    bits=st.integers(8, 24),
    offset=st.integers(-(1 << 24), 1 << 24),
)
def test_servo__any_angle__count_is_in_range_and_within_half_a_count(q_rad, bits, offset):
    servo = Servo(
        ServoSettings(torque_constant_Nm_A=1.0, encoder_bits=bits, encoder_offset_counts=offset)
    )
    servo.sense(q_rad, 0.0)
    per_turn = servo.counts_per_turn
    assert per_turn == 1 << bits
    assert 0 <= servo.counts < per_turn
    error_counts = q_rad / (2.0 * pi) * per_turn - (servo.counts - offset)
    assert abs(math.remainder(error_counts, per_turn)) <= 0.5 + 1e-3


@given(
    targets_Nm=st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30),
    dq_rad_s=st.floats(-10.0, 10.0),
)
def test_servo__any_targets_at_working_speed__torque_stays_below_the_peak(targets_Nm, dq_rad_s):
    servo = energised(0.0)
    servo.sense(0.0, dq_rad_s)
    # Back-EMF is a disturbance: until the integral has it, it moves the current by up to k dq / R.
    allowed_Nm = 15.0 + 1.5 * 1.5 * abs(dq_rad_s) / 2.0
    for target_Nm in targets_Nm:
        servo.torque_target_Nm = target_Nm
        assert abs(servo.drive()) <= allowed_Nm + 1e-9


def test_drive__command_delay__same_torque_later():
    prompt = Servo(ServoSettings(torque_constant_Nm_A=1.0))
    late = Servo(ServoSettings(torque_constant_Nm_A=1.0, command_delay_s=1e-3))
    torques = []
    for servo in (prompt, late):
        servo.is_energised = True
        servo.torque_target_Nm = 2.0
        torques.append([servo.drive() for _ in range(20)])
    assert torques[1][:2] == [0.0, 0.0]
    assert torques[1][2:] == torques[0][:-2]
