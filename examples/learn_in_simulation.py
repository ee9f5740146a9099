"""Learn gain bounds in simulation: a gym-like environment on virtual time, and a random search.

    python examples/learn_in_simulation.py --episodes 12

The environment runs the very controller, drivers and frames of the daemon in lockstep, in this
process: a step is always the same number of cycles, and the same actions give the same rewards,
bit for bit. It has the methods of gymnasium's `Env` and needs none of its code.
"""

# ruff: noqa: T201 - printing is what an example does

import argparse
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from controller.machine import State
from hil.config import load_config
from hil.messages import KellyRequest
from hil.planner import MotionLimits, MotionState, plan
from hil.simulation import Simulation

Observation = NDArray[np.float64]


class ArmEnv:
    """An arm that follows a trajectory; the action sets the bounds of its self-tuned gain.

    Observation: tracking errors (rad), their rates (rad/s) and the gains in force, joint by joint.
    Action: Kd_min and Kd_max of every joint, Nm s/rad; what is impossible is clipped.
    Reward: minus the mean squared tracking error (rad^2) of the step, a little less for gain.
    """

    def __init__(self, duration_s: float = 4.0, step_s: float = 0.25) -> None:
        self.config = load_config()
        self._request = KellyRequest(duration_s=duration_s, rate=0.5)
        self._cycles = round(step_s / self.config.loop.period_s)
        self._simulation: Simulation | None = None

    def reset(self) -> tuple[Observation, dict[str, Any]]:
        """Power up a new arm and start the trajectory."""
        simulation = self._simulation = Simulation(self.config)
        simulation.execute("enable")
        simulation.run_until(State.READY, 1000)
        start = MotionState.at_rest(simulation.control.player.setpoint.q_rad)
        limits = MotionLimits.of(
            self.config.controller.limits, self.config.trajectory.max_duration_s
        )
        simulation.play(plan(self._request, start, limits, self.config.loop.period_s))
        simulation.step()
        return self._observe(simulation), {}

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Apply bounds, run the cycles of one step; return what `gymnasium.Env.step` returns."""
        simulation = self._simulation
        if simulation is None:
            raise RuntimeError("reset the environment first")
        law = self.config.controller.law
        bounds = np.clip(np.reshape(action, (2, -1)), law.Kd_floor, law.Kd_ceiling)
        low, high = np.minimum(*bounds), np.maximum(*bounds)
        simulation.execute("gain_bounds", Kd_min=low.tolist(), Kd_max=high.tolist())
        squares = 0.0
        for _ in range(self._cycles):
            simulation.step()
            squares += float(np.square(self._error(simulation)).sum())
        state = simulation.control.machine.state
        reward = -squares / self._cycles - 1e-5 * float(high.sum())
        is_tripped, is_over = state is State.FAULT, state is State.HOLD
        reward -= 10.0 * is_tripped
        return self._observe(simulation), reward, is_tripped, is_over, {"state": state.name}

    def _observe(self, simulation: Simulation) -> Observation:
        control = simulation.control
        rates = np.subtract(control.player.setpoint.dq_rad_s, control.dq_rad_s)
        return np.concatenate([self._error(simulation), rates, control.law.Kd])

    @staticmethod
    def _error(simulation: Simulation) -> Observation:
        control = simulation.control
        return np.subtract(control.player.setpoint.q_rad, control.q_rad)


def play(env: ArmEnv, action: ArrayLike) -> float:
    """Run one episode with constant bounds; return its reward."""
    env.reset()
    total, is_over = 0.0, False
    while not is_over:
        _, reward, is_terminated, is_truncated, _ = env.step(action)
        total += reward
        is_over = is_terminated or is_truncated
    return total


def learn(env: ArmEnv, episodes: int, seed: int = 1) -> tuple[NDArray[np.float64], list[float]]:
    """Search bounds at random around the best so far; return them and the best reward over time."""
    chance = np.random.default_rng(seed)
    law = env.config.controller.law
    best = np.array([law.Kd_min, law.Kd_max], dtype=float)
    rewards = [play(env, best)]
    for episode in range(1, episodes):
        tried = best * np.exp(chance.normal(0.0, 0.4, best.shape))
        tried = np.clip(tried, law.Kd_floor, law.Kd_ceiling)
        reward = play(env, tried)
        if reward > rewards[-1]:
            best = tried
        rewards.append(max(reward, rewards[-1]))
        print(f"episode {episode:3}: reward {reward:9.5f}, best {rewards[-1]:9.5f}", flush=True)
    return best, rewards


def main() -> None:
    """Learn, and say how the bounds would be sent to the real arm."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--duration", type=float, default=4.0, metavar="S", help="of an episode")
    options = parser.parse_args()
    best, rewards = learn(ArmEnv(options.duration), options.episodes)
    low, high = np.round(np.sort(best, axis=0), 2).tolist()
    print(f"reward {rewards[0]:.5f} at first, {rewards[-1]:.5f} now; on the arm:")
    print(f"hil send gain-bounds --min {' '.join(map(str, low))} --max {' '.join(map(str, high))}")


if __name__ == "__main__":
    main()
