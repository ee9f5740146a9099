"""Tune gain bounds on a running arm, from another desk: move, measure, narrow, compare.

    python examples/remote_tuning.py --arm bench --connect tcp/127.0.0.1:7447

Authority is taken for as long as the session lasts: nobody else can move the arm in between. A
second operator is told who is at work; anybody may still `hil send estop`.
"""

# ruff: noqa: T201 - printing is what an example does

import argparse

import numpy as np

from hil.client import Arm, NoAuthorityError
from hil.errors import HilError

BOUNDS = ((0.5, 1.0), (1.0, 2.0), (1.5, 4.0))
"""Kd_min and Kd_max to compare, of every joint, Nm s/rad."""
SWING_RAD = 0.3


def measure(arm: Arm, duration_s: float) -> float:
    """Swing there and back; return the root mean square of the tracking error in rad."""
    start = arm.state.q_des_rad
    points = [start, start + SWING_RAD, start - SWING_RAD, start]
    log = arm.record(duration_s + 10.0)
    arm.follow(np.linspace(0.0, duration_s, len(points)).tolist(), points)
    rows = log.rows()
    moving = rows[rows["t_ref_s"] > 0.0]
    error_rad = moving["q_des_rad"] - moving["q_meas_rad"]
    print(f"    {len(moving)} samples, {log.lost} lost", flush=True)
    return float(np.sqrt(np.mean(np.square(error_rad))))


def tune(arm: Arm, duration_s: float) -> tuple[float, float]:
    """Compare all bounds on the same motion; leave the best in force and return them."""
    joints = len(arm.state.q_rad)
    errors = {}
    for low, high in BOUNDS:
        arm.set_gain_bounds([low] * joints, [high] * joints)
        errors[low, high] = measure(arm, duration_s)
        print(f"Kd {low:g} to {high:g}: {errors[low, high] * 1e3:.2f} mrad", flush=True)
    best = min(errors, key=errors.__getitem__)
    arm.set_gain_bounds([best[0]] * joints, [best[1]] * joints)
    return best


def main() -> None:
    """Take the arm, tune it, and leave it without power."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arm", default="bench")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--duration", type=float, default=6.0, metavar="S", help="of a motion")
    options = parser.parse_args()
    try:
        with Arm(options.arm, [options.connect], operator="tuning") as arm:
            arm.enable()
            low, high = tune(arm, options.duration)
            print(f"best: Kd {low:g} to {high:g}")
            arm.disable()
    except NoAuthorityError as error:
        raise SystemExit(f"the arm is taken: {error}") from error
    except HilError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
