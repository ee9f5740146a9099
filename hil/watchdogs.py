"""Whether the amplifiers take torque off by themselves when the master dies."""

from hil.config import Config
from hil.finding import Finding

REMEDY = "use a power relay or an emergency-stop circuit (docs/safety.md), and try it"


def joints_without(config: Config) -> str:
    """Name the joints whose amplifiers have no command watchdog to rely on; empty if all have.

    Such a family has none in its protocol, or none that can be set or read back over the bus
    (`AxisSettings.watchdog_s`).
    """
    names = [
        f"joint {joint} ({getattr(axis, 'variant', axis.family)})"
        for joint, axis in enumerate(config.axes, start=1)
        if axis.watchdog_s is None
    ]
    return ", ".join(names)


def watchdog_warning(config: Config) -> str:
    """Say in one line what may happen when the master dies, and the remedy; empty if nothing."""
    joints = joints_without(config)
    if not joints:
        return ""
    found = f"torque of {joints} stays on if the daemon dies"
    return f"no command watchdog to rely on: {found}; {REMEDY}"


def check_watchdogs(config: Config) -> Finding:
    """Judge it for `hil doctor`."""
    joints = joints_without(config)
    if joints:
        found = f"none to rely on: torque of {joints} stays on if the daemon dies"
        return Finding("watchdogs", "warn", found, REMEDY)
    longest_s = max(axis.watchdog_s or 0.0 for axis in config.axes)
    return Finding("watchdogs", "pass", f"torque off {1e3 * longest_s:g} ms after the last command")
