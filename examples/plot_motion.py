"""Move a running arm and plot what it did: a notebook as a script; every `# %%` begins a cell.

    python examples/plot_motion.py --arm bench --connect tcp/127.0.0.1:7447 --out motion.png

VS Code, Spyder and Jupytext open it as a notebook.
"""

# ruff: noqa: T201 - printing is what an example does

# %% what is needed, and which arm
import argparse

import matplotlib as mpl
import numpy as np

mpl.use("Agg")  # leave this out in a notebook
import matplotlib.pyplot as plt

from hil.client import Arm

parser = argparse.ArgumentParser()
parser.add_argument("--arm", default="bench")
parser.add_argument("--connect", default="tcp/127.0.0.1:7447", metavar="ENDPOINT")
parser.add_argument("--out", default="motion.png", metavar="FILE")
options, _ = parser.parse_known_args()

# %% play a chirp, 100 points a second; telemetry is kept from before it on
t_s = np.arange(0.0, 6.0, 0.01)
fade = np.sin(np.pi * t_s / t_s[-1]) ** 2
with Arm(options.arm, [options.connect], operator="notebook") as arm:
    arm.enable()
    start_rad = arm.state.q_des_rad
    log = arm.record(60.0)
    arm.play(start_rad + 0.3 * (fade * np.sin(2 * np.pi * 0.25 * t_s**1.3))[:, None], 0.01)
    arm.disable()
rows = log.rows()
print(f"{len(rows)} cycles, {log.lost} lost; columns: {', '.join(rows.dtype.names)}")

# %% joint angles, error and torque over time
time_s = (rows["t_ns"] - rows["t_ns"][0]) * 1e-9
figure, axes = plt.subplots(3, 1, sharex=True, figsize=(9, 7), layout="constrained")
for joint in range(rows["q_meas_rad"].shape[1]):
    axes[0].plot(time_s, rows["q_des_rad"][:, joint], "--", color=f"C{joint}")
    axes[0].plot(
        time_s, rows["q_meas_rad"][:, joint], color=f"C{joint}", label=f"joint {joint + 1}"
    )
    error_mrad = 1e3 * (rows["q_des_rad"] - rows["q_meas_rad"])[:, joint]
    axes[1].plot(time_s, error_mrad, color=f"C{joint}")
    axes[2].plot(time_s, rows["tau_sent_Nm"][:, joint], color=f"C{joint}")
for ax, label in zip(
    axes, ("q (rad), reference dashed", "error (mrad)", "torque (Nm)"), strict=True
):
    ax.set_ylabel(label)
    ax.grid(alpha=0.3)
axes[0].legend()
axes[-1].set_xlabel("time (s)")
figure.savefig(options.out)
print(f"written: {options.out}")
