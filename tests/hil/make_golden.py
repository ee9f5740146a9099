"""Makes the golden recordings anew: `python -m tests.hil.make_golden`.

To be made anew only when a change of what the controller sends is intended.
"""

import shutil
import tempfile
from pathlib import Path

from hil.client import Client
from tests.hil.lab import Lab
from tests.hil.test_replay import GOLDEN, simulate


def record_daemon(path: Path) -> None:
    """Record a short run of a daemon in real time, with an emergency stop at its end."""
    with tempfile.TemporaryDirectory() as directory:
        lab = Lab(Path(directory))
        try:
            lab.emulate()
            arm = lab.run()
            arm.make_ready()
            client: Client = arm.client
            client.command("trajectory", kind="move", target_rad=[0.2, -0.1])
            arm.wait_cycles(150)
            client.command("gain_bounds", Kd_min=[1.5, 1.5], Kd_max=[2.0, 2.5])
            arm.wait_cycles(100)
            client.command("estop")
        finally:
            lab.close()
        shutil.copy(next(Path(directory).rglob("*.mcap")), path)


def main() -> None:
    """Write every golden recording."""
    GOLDEN.mkdir(exist_ok=True)
    simulate(GOLDEN / "bench_h.mcap")
    levant = {"controller": {"velocity": {"estimator": "levant"}}, "arm": {"preset": "pelican_h"}}
    simulate(GOLDEN / "pelican_h_levant.mcap", settings=levant)
    record_daemon(GOLDEN / "daemon.mcap")


if __name__ == "__main__":
    main()
