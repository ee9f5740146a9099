"""The signals of `damiao.dbc` for one configured motor."""

from drivers.database import AxisSignals, Scale
from drivers.mit.codec import (
    CLEAR_FAULT,
    DISABLE,
    ENABLE,
    POSITION_CODES,
    SET_ZERO,
    SHORT_CODES,
)
from drivers.mit.settings import MitSettings


def signals(settings: MitSettings) -> AxisSignals | None:
    """Return scales of the joint, direction and offset included; None for other than Damiao.

    A DBC cannot tell the other variants' frames apart: they answer all motors' commands under one
    identifier, or put numbers into it.
    """
    if settings.variant != "damiao":
        return None
    ranges = settings.ranges
    torque = _span(settings.direction * ranges.torque_Nm, SHORT_CODES, "Nm")
    position = _span(settings.direction * ranges.position_rad, POSITION_CODES, "rad")
    names = {ENABLE: "enable", DISABLE: "disable", SET_ZERO: "set zero", CLEAR_FAULT: "clear fault"}
    return AxisSignals(
        "damiao.dbc",
        {
            "Position": position._replace(offset=position.offset + settings.offset_rad),
            "Velocity": _span(settings.direction * ranges.velocity_rad_s, SHORT_CODES, "rad/s"),
            "Torque": torque,
            "TargetTorque": torque,
            "Kp": Scale(ranges.kp_Nm_rad / SHORT_CODES, 0.0, "Nm/rad"),
            "Kd": Scale(ranges.kd_Nms_rad / SHORT_CODES, 0.0, "Nm s/rad"),
        },
        ids={"Reply": settings.reply_id},
        payloads={("Command", data): name for data, name in names.items()},
    )


def _span(limit: float, codes: int, unit: str) -> Scale:
    """Codes from 0 on span -limit to +limit."""
    return Scale(2.0 * limit / codes, -limit, unit)
