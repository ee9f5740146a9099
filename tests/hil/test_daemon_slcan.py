"""The daemon at an emulated serial adapter: processes, a pty, and an adapter that is pulled out."""

import os

from controller.machine import State
from tests.hil.lab import Arm, wait_until, whole

NOTHING_LOST = ("send_failures", "late_frames", "unknown_frames", "error_frames")


class SlcanLab:
    """Emulator and daemon at a pty under a fixed name."""

    def __init__(self, lab, option=""):
        self.lab = lab
        self.link = lab.directory / "adapter"
        self.offered = f"slcan:pty={self.link}{option}"
        self.joined = f"slcan:{self.link}@1000000{option}"

    def emulate(self):
        process = self.lab.start("emulate", *self.lab.settings(), "--bus", self.offered)
        assert f"on slcan:{self.link}, lockstep" in process.wait_for_line()
        return process

    def start_daemon(self):
        options, record = self.lab.run_options()
        return self.lab.start(*options, "--bus", self.joined), record

    def run(self):
        daemon, record = self.start_daemon()
        daemon.wait_for_line()
        return Arm(daemon, self.lab.connect(), record)


def test_run__acknowledged_slcan_in_lockstep__enables_moves_and_loses_nothing(lab):
    slcan = SlcanLab(lab, ",ack")
    slcan.emulate()
    arm = slcan.run()
    arm.make_ready()
    arm.swing(duration_s=2.0)
    arm.wait_for(State.HOLD)
    arm.client.command("disable")
    arm.wait_for(State.IDLE)
    wait_until(lambda: arm.statuses, what="status")
    assert arm.daemon.end() == 0
    assert arm.daemon.stderr == ""
    status = arm.statuses[-1]
    assert [status[name] for name in NOTHING_LOST] == [0] * len(NOTHING_LOST)
    samples = whole(arm.recording).samples
    assert not samples["fault"].any()
    moved = samples["q_meas_rad"].max(axis=0) - samples["q_meas_rad"].min(axis=0)
    assert (moved > 0.3).all()


def test_run__adapter_pulled_out_and_plugged_in__daemon_says_so_and_starts_again(lab):
    slcan = SlcanLab(lab)
    emulator = slcan.emulate()
    arm = slcan.run()
    arm.make_ready()
    assert emulator.end() == 0
    assert not os.path.lexists(slcan.link)
    assert arm.daemon.wait() == 1
    assert f"the bus slcan:{slcan.link} is gone: adapter unplugged" in arm.daemon.stderr
    assert "Traceback" not in arm.daemon.stderr
    slcan.emulate()
    again = slcan.run()
    again.make_ready()
    assert again.daemon.end() == 0


def test_emulate__pty_without_a_name__prints_the_one_it_got(lab):
    emulator = lab.start("emulate", *lab.settings(), "--bus", "slcan:pty", "--time", "wall")
    assert " on slcan:/dev/pts/" in emulator.wait_for_line()
    assert emulator.end() == 0
    assert emulator.stderr == ""
