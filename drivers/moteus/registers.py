"""moteus' registers, modes, fault codes, and what integer values of registers stand for.

Sources: moteus documentation, "Register Reference" (docs/protocol/registers.md).
"""

import math
from enum import IntEnum


class Resolution(IntEnum):
    """How a register's value is written; the second nibble of a subframe, shifted by two."""

    INT8 = 0
    INT16 = 1
    INT32 = 2
    FLOAT = 3


INT_MAX = (127, 32767, 2147483647)
"""Largest value of each integer resolution; one below its negative stands for NaN."""


class Register(IntEnum):
    """Registers in use here."""

    MODE = 0x000
    POSITION = 0x001
    VELOCITY = 0x002
    TORQUE = 0x003
    Q_CURRENT = 0x004
    D_CURRENT = 0x005
    ABS_POSITION = 0x006
    POWER = 0x007
    MOTOR_TEMPERATURE = 0x00A
    TRAJECTORY_COMPLETE = 0x00B
    HOME_STATE = 0x00C
    VOLTAGE = 0x00D
    TEMPERATURE = 0x00E
    FAULT = 0x00F
    COMMAND_Q_CURRENT = 0x01C
    COMMAND_D_CURRENT = 0x01D
    COMMAND_POSITION = 0x020
    COMMAND_VELOCITY = 0x021
    COMMAND_TORQUE = 0x022
    COMMAND_KP_SCALE = 0x023
    COMMAND_KD_SCALE = 0x024
    COMMAND_MAX_TORQUE = 0x025
    COMMAND_STOP_POSITION = 0x026
    COMMAND_TIMEOUT = 0x027
    COMMAND_VELOCITY_LIMIT = 0x028
    COMMAND_ACCELERATION_LIMIT = 0x029
    COMMAND_FIXED_VOLTAGE = 0x02A
    COMMAND_ILIMIT_SCALE = 0x02B
    COMMAND_FIXED_CURRENT = 0x02C
    COMMAND_IGNORE_BOUNDS = 0x02D
    POSITION_KP = 0x030
    POSITION_KI = 0x031
    POSITION_KD = 0x032
    POSITION_FEEDFORWARD = 0x033
    POSITION_COMMAND = 0x034
    CONTROL_POSITION = 0x038
    CONTROL_VELOCITY = 0x039
    CONTROL_TORQUE = 0x03A
    ENCODER_0_POSITION = 0x050
    ENCODER_0_VELOCITY = 0x051
    ENCODER_VALIDITY = 0x058
    MILLISECOND_COUNTER = 0x070
    MODEL_NUMBER = 0x100
    FIRMWARE_VERSION = 0x101
    REGISTER_MAP_VERSION = 0x102
    SERIAL_NUMBER_1 = 0x120
    SERIAL_NUMBER_2 = 0x121
    SERIAL_NUMBER_3 = 0x122
    SET_OUTPUT_NEAREST = 0x130
    SET_OUTPUT_EXACT = 0x131
    REQUIRE_REINDEX = 0x132
    RECAPTURE = 0x133
    UUID_1 = 0x150
    UUID_MASK_1 = 0x154
    UUID_MASK_CAPABLE = 0x158
    INJECT_FAULT = 0x7F0
    """Emulated controller only: writing a code faults it. A real one knows no such register."""


class Mode(IntEnum):
    """Values of register MODE."""

    STOPPED = 0
    FAULT = 1
    ENABLING = 2
    CALIBRATING = 3
    CALIBRATION_COMPLETE = 4
    PWM = 5
    VOLTAGE = 6
    VOLTAGE_FOC = 7
    VOLTAGE_DQ = 8
    CURRENT = 9
    POSITION = 10
    TIMEOUT = 11
    ZERO_VELOCITY = 12
    STAY_WITHIN = 13
    MEASURE_INDUCTANCE = 14
    BRAKE = 15


MODE_COUNT = 16
FAULTS = {
    32: "calibration fault",
    33: "motor driver fault",
    34: "over voltage",
    35: "encoder fault",
    36: "motor not configured",
    37: "pwm cycle overrun",
    38: "over temperature",
    39: "outside limit",
    40: "under voltage",
    41: "config changed",
    42: "theta invalid",
    43: "position invalid",
    44: "driver enable fault",
    45: "stop position deprecated",
    46: "timing violation",
    47: "bemf feedforward no accel",
    48: "invalid limits",
}
"""Register FAULT in mode 1. In other modes codes from 96 on only say what limits the output."""
LIMIT_MAX_TORQUE = 102
"""Register FAULT outside mode 1: the commanded maximum torque limits the output."""

Scale = tuple[float, float, float]
"""Physical value of one LSB as int8, int16, int32."""

INTEGER: Scale = (1.0, 1.0, 1.0)
POSITION: Scale = (0.01, 0.0001, 0.00001)
VELOCITY: Scale = (0.1, 0.00025, 0.00001)
ACCELERATION: Scale = (0.05, 0.001, 0.00001)
TORQUE: Scale = (0.5, 0.01, 0.001)
PWM: Scale = (1.0 / 127.0, 1.0 / 32767.0, 1.0 / 2147483647.0)
VOLTAGE: Scale = (0.5, 0.1, 0.001)
TEMPERATURE: Scale = (1.0, 0.1, 0.001)
TIME: Scale = (0.01, 0.001, 0.000001)
CURRENT: Scale = (1.0, 0.1, 0.001)
POWER: Scale = (10.0, 0.05, 0.0001)

_SCALES: dict[int, Scale] = {
    **dict.fromkeys((0x001, 0x006, 0x020, 0x026, 0x038, 0x03B, 0x040, 0x041), POSITION),
    **dict.fromkeys((0x050, 0x052, 0x054, 0x130, 0x131), POSITION),
    **dict.fromkeys((0x002, 0x021, 0x028, 0x039, 0x03C, 0x051, 0x053, 0x055), VELOCITY),
    **dict.fromkeys((0x003, 0x022, 0x025, 0x042, 0x045, *range(0x030, 0x035)), TORQUE),
    **dict.fromkeys((0x03A, 0x03D), TORQUE),
    **dict.fromkeys((0x023, 0x024, 0x02B, 0x043, 0x044, 0x047), PWM),
    **dict.fromkeys((0x004, 0x005, 0x01C, 0x01D, 0x02C), CURRENT),
    **dict.fromkeys((0x027, 0x046), TIME),
    **dict.fromkeys((0x00A, 0x00E), TEMPERATURE),
    **dict.fromkeys((0x00D, 0x02A), VOLTAGE),
    0x007: POWER,
    0x029: ACCELERATION,
}


def scale_of(register: int) -> Scale:
    """Return what the integers of a register stand for."""
    return _SCALES.get(register, INTEGER)


def encode_value(value: float, scale: Scale, resolution: int) -> float | int:
    """Return the number to write for a physical value: saturated, NaN as the lowest integer."""
    if resolution == Resolution.FLOAT:
        return value
    top = INT_MAX[resolution]
    if not math.isfinite(value):
        return -top - 1
    return int(max(-top, min(top, value / scale[resolution])))


def decode_value(number: float, scale: Scale, resolution: int) -> float:
    """Return the physical value of a number read, NaN for the lowest integer of a quantity."""
    if resolution == Resolution.FLOAT:
        return number
    if scale is INTEGER:
        return number
    if number == -INT_MAX[resolution] - 1:
        return math.nan
    return number * scale[resolution]
