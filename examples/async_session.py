"""An asyncio program: moves an arm while it watches the tracking error, and stops at a bound.

python examples/async_session.py --arm bench --connect tcp/127.0.0.1:7447
"""

# ruff: noqa: T201 - printing is what an example does

import argparse
import asyncio

import numpy as np

from hil.aclient import AsyncArm
from hil.errors import HilError


class Watch:
    """Follows the tracking error.

    Attributes:
        largest_rad: The largest so far.
    """

    def __init__(self, arm: AsyncArm, bound_rad: float) -> None:
        self.largest_rad = 0.0
        self._arm = arm
        self._bound_rad = bound_rad

    async def run(self) -> None:
        """Stop the arm when it strays from its reference."""
        async for rows in self._arm.telemetry():
            error_rad = float(np.abs(rows["q_des_rad"] - rows["q_meas_rad"]).max())
            self.largest_rad = max(self.largest_rad, error_rad)
            if error_rad > self._bound_rad:
                await self._arm.stop()


async def run(name: str, endpoint: str, bound_rad: float) -> None:
    """Move, and watch it meanwhile."""
    async with AsyncArm(name, [endpoint], operator="async") as arm:
        await arm.enable()
        watch = Watch(arm, bound_rad)
        watching = asyncio.create_task(watch.run())
        state = await arm.state()
        duration_s = await arm.move((state.q_des_rad + 0.4).tolist(), speed_scale=0.5)
        watching.cancel()
        print(f"moved for {duration_s:.2f} s, error up to {1e3 * watch.largest_rad:.1f} mrad")
        await arm.disable()


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--arm", default="bench")
    parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
    parser.add_argument("--bound", type=float, default=0.2, metavar="RAD")
    options = parser.parse_args()
    try:
        asyncio.run(run(options.arm, options.connect, options.bound))
    except HilError as error:
        raise SystemExit(str(error)) from error


if __name__ == "__main__":
    main()
