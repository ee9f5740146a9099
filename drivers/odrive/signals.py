"""The signals of `odrive.dbc` for one configured axis."""

from math import tau

from drivers.database import AxisSignals, Scale
from drivers.odrive.settings import OdriveSettings


def signals(settings: OdriveSettings) -> AxisSignals:
    """Return scales of the joint: direction, gear and offset are in them.

    The position is the drive's own, of many turns; whole turns of the joint are not taken off.
    """
    rad_per_rev = settings.direction * tau / settings.gear_ratio
    torque = Scale(settings.direction * settings.gear_ratio, 0.0, "Nm")
    return AxisSignals(
        "odrive.dbc",
        {
            "Position": Scale(rad_per_rev, settings.offset_rad, "rad"),
            "Velocity": Scale(rad_per_rev, 0.0, "rad/s"),
            "TorqueSetpoint": torque,
            "TorqueTarget": torque,
            "TorqueEstimate": torque,
        },
    )
