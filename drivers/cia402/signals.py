"""The signals of `cia402.dbc` for one configured drive."""

from math import tau

from drivers.cia402.settings import Cia402Settings
from drivers.database import AxisSignals, Scale


def signals(settings: Cia402Settings) -> AxisSignals:
    """Return scales of the joint: direction and offset are in them.

    The position is that of the single-turn encoder: whole turns are left out. The current stays per
    mille of 6075, which is not configured.
    """
    rad_per_count = settings.direction * tau / settings.counts_per_turn
    torque = Scale(settings.direction * settings.rated_torque_Nm / 1000.0, 0.0, "Nm")
    return AxisSignals(
        "cia402.dbc",
        {
            "Position": Scale(rad_per_count, settings.offset_rad, "rad"),
            "Velocity": Scale(rad_per_count, 0.0, "rad/s"),
            "Torque": torque,
            "TargetTorque": torque,
        },
    )
