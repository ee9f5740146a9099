"""Telemetry kept as it comes: the newest seconds, as numpy arrays."""

import threading
from collections import deque
from collections.abc import Callable
from time import monotonic
from typing import Any

import numpy as np

from hil.errors import HilError
from hil.fixed_protobuf import Records

Take = Callable[[Records], None]


class NoTelemetryError(HilError):
    """No telemetry comes; is the daemon up?"""


class TelemetryLog:
    """The samples of the last so many seconds. Several threads may use it.

    Args:
        keep_s: How much is kept.

    Attributes:
        received: Samples so far, also those no longer kept.
        lost: Samples that are missing between these, by their sequence numbers.
    """

    def __init__(self, keep_s: float) -> None:
        self._keep_ns = keep_s * 1e9
        self._batches: deque[Records] = deque()
        self._listeners: list[Take] = []
        self._change = threading.Condition()
        self._seq = -1
        self.received = 0
        self.lost = 0

    def take(self, rows: Records) -> None:
        """Add a batch, at least one row."""
        with self._change:
            self._count(rows)
            self._batches.append(rows)
            oldest_ns = rows["t_ns"][-1] - self._keep_ns
            while self._batches[0]["t_ns"][-1] < oldest_ns:
                self._batches.popleft()
            listeners = tuple(self._listeners)
            self._change.notify_all()
        for listener in listeners:
            listener(rows)

    def pass_on(self, take: Take) -> None:
        """Have every further batch passed to `take`, too."""
        with self._change:
            self._listeners.append(take)

    def pass_on_no_more(self, take: Take) -> None:
        """End what `pass_on` began."""
        with self._change:
            self._listeners.remove(take)

    def _count(self, rows: Records) -> None:
        first, last = int(rows["seq"][0]), int(rows["seq"][-1])
        span = last - first + 1
        if 0 <= self._seq < first:  # a lower one is the first of a new daemon
            span += first - self._seq - 1
        self.lost += max(0, span - len(rows))
        self.received += len(rows)
        self._seq = last

    def rows(self) -> Records:
        """Return all samples kept, oldest first; columns are the fields of `hil.v1.Sample`.

        Raises:
            NoTelemetryError: If there are none.
        """
        with self._change:
            batches = list(self._batches)
        if not batches:
            raise NoTelemetryError("no telemetry has come yet")
        return np.concatenate(batches)

    def last(self, timeout_s: float) -> Any:  # noqa: ANN401 - numpy.void
        """Return the newest row, waiting for the first one.

        Raises:
            NoTelemetryError: If none comes.
        """
        with self._change:
            if not self._change.wait_for(lambda: self._batches, timeout_s):
                raise NoTelemetryError(f"no telemetry within {timeout_s:g} s; is `hil run` up?")
            return self._batches[-1][-1]

    def wait(self, condition: Callable[[Any], bool], timeout_s: float) -> Any:  # noqa: ANN401
        """Wait until the newest row fulfils a condition; return the newest row at the end.

        Raises:
            NoTelemetryError: If there is no telemetry at all.
        """
        until_s = monotonic() + timeout_s
        with self._change:
            self._change.wait_for(
                lambda: bool(self._batches) and condition(self._batches[-1][-1]),
                max(0.0, until_s - monotonic()),
            )
            if not self._batches:
                raise NoTelemetryError(f"no telemetry within {timeout_s:g} s; is `hil run` up?")
            return self._batches[-1][-1]
