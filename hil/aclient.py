"""`hil.client.Arm` for programs that use asyncio: nothing here holds up the event loop.

Requests wait in threads; telemetry comes as an asynchronous iterator.
"""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from functools import partial
from types import TracebackType
from typing import Any, Final, ParamSpec, Self, TypeVar

from numpy.typing import ArrayLike

from hil.client import DEFAULT_ENDPOINT, Arm, ArmState
from hil.fixed_protobuf import Records
from hil.telemetry_log import TelemetryLog

P = ParamSpec("P")
R = TypeVar("R")

BATCHES_KEPT: Final = 1000
"""What an iterator may be behind, some 10 s; then the oldest batches are lost to it."""


class AsyncArm:
    """One arm, under this program's authority while the `async with` block lasts.

    Methods are those of `hil.client.Arm`, to be awaited; errors are the same. A task that is
    cancelled while it waits for a motion leaves the motion as it is; leaving the block by an
    exception, `CancelledError` among them, stops the arm.

    Args:
        name: Of the arm.
        endpoints: Zenoh endpoints of the daemon or of a router.
        operator: Who this is, for the record; none: user and host.
        observe: Only look: no authority is taken.

    Example:
        >>> async with AsyncArm("bench") as arm:                            # doctest: +SKIP
        ...     await arm.enable()
        ...     await arm.move([0.5, -0.3])
    """

    def __init__(
        self,
        name: str = "bench",
        endpoints: Sequence[str] = (DEFAULT_ENDPOINT,),
        *,
        operator: str | None = None,
        observe: bool = False,
    ) -> None:
        self._connect = partial(Arm, name, endpoints, operator=operator, observe=observe)
        self._arm: Arm | None = None

    async def __aenter__(self) -> Self:
        arm = await asyncio.to_thread(self._connect)
        await asyncio.to_thread(arm.__enter__)
        self._arm = arm
        return self

    async def __aexit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        await asyncio.shield(asyncio.to_thread(self.sync.__exit__, kind, error, trace))

    @property
    def sync(self) -> Arm:
        """The arm itself, whose methods wait.

        Raises:
            RuntimeError: Outside of the `async with` block.
        """
        if self._arm is None:
            raise RuntimeError("AsyncArm is to be used in an `async with` block")
        return self._arm

    async def state(self) -> ArmState:
        """The newest cycle known, at least that in which the last command took effect."""
        return await asyncio.to_thread(lambda: self.sync.state)

    async def enable(self) -> None:
        """Power on; the arm holds its pose."""
        await asyncio.to_thread(self.sync.enable)

    async def disable(self) -> None:
        """Damped stop, then power off."""
        await asyncio.to_thread(self.sync.disable)

    async def stop(self) -> None:
        """Slow down along the path and hold, under power."""
        await asyncio.to_thread(self.sync.stop)

    async def estop(self) -> None:
        """Torque off at once; latched. Needs no authority."""
        await asyncio.to_thread(self.sync.estop)

    async def reset(self) -> None:
        """Clear a latched fault or emergency stop; it does not enable."""
        await asyncio.to_thread(self.sync.reset)

    async def set_gain_bounds(self, Kd_min: Sequence[float], Kd_max: Sequence[float]) -> None:
        """Let the bounds of the self-tuned gain ramp to these, Nm s/rad."""
        await asyncio.to_thread(self.sync.set_gain_bounds, Kd_min, Kd_max)

    async def start(self, request: Mapping[str, Any]) -> float:
        """Start a trajectory of any kind; return its duration in s."""
        return await asyncio.to_thread(self.sync.start, request)

    async def move(
        self, target_rad: Sequence[float], *, speed_scale: float = 1.0, wait: bool = True
    ) -> float:
        """Move to a pose as fast as the limits allow; return the duration in s."""
        return await self._do(self.sync.move, target_rad, speed_scale=speed_scale, wait=wait)

    async def follow(
        self, times_s: Sequence[float], points_rad: ArrayLike, *, wait: bool = True
    ) -> float:
        """Pass through timed points, from 0 s, at rest at both ends."""
        return await self._do(self.sync.follow, times_s, points_rad, wait=wait)

    async def play(self, q_rad: ArrayLike, period_s: float, *, wait: bool = True) -> float:
        """Play an array, samples x joints, so many seconds apart."""
        return await self._do(self.sync.play, q_rad, period_s, wait=wait)

    async def wait(self, timeout_s: float) -> ArmState:
        """Wait for the end of the running motion."""
        return await asyncio.to_thread(self.sync.wait, timeout_s)

    async def _do(self, act: Callable[P, R], *arguments: P.args, **named: P.kwargs) -> R:
        return await asyncio.to_thread(act, *arguments, **named)

    def record(self, keep_s: float = 60.0) -> TelemetryLog:
        """Return a log of what comes from now on, of so many seconds at most."""
        return self.sync.record(keep_s)

    async def telemetry(self) -> AsyncIterator[Records]:
        """Yield every batch of samples from now on: `async for rows in arm.telemetry(): ...`."""
        loop, news = asyncio.get_running_loop(), asyncio.Event()
        batches: deque[Records] = deque(maxlen=BATCHES_KEPT)

        def take(rows: Records) -> None:
            batches.append(rows)
            loop.call_soon_threadsafe(news.set)

        stop = self.sync.on_telemetry(take)
        try:
            while True:
                await news.wait()
                news.clear()
                while batches:
                    yield batches.popleft()
        finally:
            stop()
