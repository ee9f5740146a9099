"""The wire model: how long frames take, who goes first, what errors cost, how busy the bus is.

It has no clock. Its owner sends frames at instants, lets it `step` on, and is handed each frame
at the instant at which it has arrived. Every frame on the wire is acknowledged.

Source: ISO 11898-1:2015, 10.4 (frames), 10.7 (arbitration), 10.11 (error frames).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from random import Random

from drivers.frame import FRAME_SIZE
from sim_backend.can_controller import BUS_OFF_LIMIT, CanController, ReportSink
from sim_backend.settings import WireSettings
from sim_backend.wire_bits import INTERFRAME_BITS, arbitration_key, fd_frame_bits, frame_bits

ERROR_FLAG_BITS = 12
"""An active error flag and its echo, at most (6 + 6), after the bit that was wrong."""
PASSIVE_FLAG_BITS = 6
ERROR_DELIMITER_BITS = 8
SUSPEND_BITS = 8
"""An error-passive node lets others go first for so long after it has transmitted."""
RECOVERY_SEQUENCES = 128
SEQUENCE_BITS = 11
"""Recessive bits in a row; any frame and any error frame ends with as many."""

Deliver = Callable[[bytes, CanController], None]
"""Called with each frame that has arrived and the controller that sent it."""
_Entry = tuple[int, int, int, CanController, bytes]
"""A frame that waits: arbitration key, number, sent at, sender, record."""


@dataclass(slots=True)
class WireLoad:
    """What the wire did since an instant. A frame counts where it ends."""

    start_ns: int = 0
    busy_ns: int = 0
    frames: int = 0
    errors: int = 0
    """Error frames."""
    wait_max_ns: int = 0
    """Longest time from the sending of a frame to the begin of its successful transmission."""


class WireModel:
    """One CAN bus.

    Attributes:
        now_ns: The instant up to which everything has happened.
        last: The last window that is over, None before the first is.
        peak_share: Largest share of a window in which the wire was busy.
        window_ns: Length of a window.
        on_window: Called with each window when it is over.
    """

    def __init__(
        self, settings: WireSettings, deliver: Deliver, *, bit_rate: int, data_bit_rate: int
    ) -> None:
        self.now_ns = 0
        self.last: WireLoad | None = None
        self.peak_share = 0.0
        self.window_ns = round(settings.window_s * 1e9)
        self.on_window: Callable[[WireLoad], None] | None = None
        self._deliver = deliver
        self._bit_ns = 1e9 / bit_rate
        self._data_bit_ns = 1e9 / data_bit_rate
        self._interframe_ns = self._span_ns(INTERFRAME_BITS)
        self._is_recovering = settings.is_recovering
        self._random = Random(settings.seed)  # noqa: S311 - disturbances, no secrets
        self._nodes: list[CanController] = []
        self._off: list[CanController] = []
        self._queue: list[_Entry] = []
        self._sent = 0
        self._current: _Entry | None = None
        self._is_disturbed = False
        self._start_ns = self._end_ns = self._free_ns = 0
        self._before = WireLoad()
        self._window = WireLoad()
        self._window_end_ns = self.window_ns
        self._has_counts = False
        self.set_bit_error_rate(settings.bit_error_rate)

    # --- nodes and their frames --------------------------------------------------------------

    def join(self, name: str, on_report: ReportSink | None = None) -> CanController:
        """Add a controller; `on_report` takes its error reports."""
        node = CanController(name, on_report)
        self._nodes.append(node)
        return node

    def leave(self, node: CanController) -> None:
        """Remove a controller; what it has queued is still sent."""
        self._nodes.remove(node)
        if node in self._off:
            self._off.remove(node)

    def send(self, node: CanController, frame: bytes) -> None:
        """Queue a frame at the present instant; it is lost if its node is bus-off."""
        if node.is_bus_off:
            node.frames_dropped += 1
            return
        self._sent += 1
        self._queue.append((arbitration_key(frame), self._sent, self.now_ns, node, frame))

    def _drop_queue_of(self, node: CanController) -> None:
        kept = [entry for entry in self._queue if entry[3] is not node]
        node.frames_dropped += len(self._queue) - len(kept)
        self._queue = kept

    # --- faults on request -------------------------------------------------------------------

    def set_bit_error_rate(self, rate: float) -> None:
        """Disturb each bit with this probability from the next frame on, 0 <= rate < 1."""
        self._log_intact = math.log1p(-rate)

    def fail_next(self, node: CanController, frames: int) -> None:
        """Let the node's next transmissions fail half way, repetitions included."""
        node.failures_left = frames

    def force_bus_off(self, node: CanController) -> None:
        """Take a node off the bus, as 32 failed transmissions in a row would."""
        if not node.is_bus_off:
            node.tec = BUS_OFF_LIMIT
            self._go_bus_off(node)

    # --- time --------------------------------------------------------------------------------

    @property
    def next_ns(self) -> int | None:
        """When to `step` at the latest unless somebody sends before; None if never."""
        if self._current is not None:
            return self._end_ns
        if self._queue:
            return max(self._next_start_ns(), self.now_ns) + 1
        recovery_ns = self._next_recovery_ns()
        return None if recovery_ns is None else recovery_ns + 1

    def step(self, until_ns: int) -> bool:
        """Let the next frame arrive or fail, or a node recover; False if nothing does until then.

        A frame that arrives at `until_ns` is included. One that could start at `until_ns` waits
        for the next call, so that all that are sent at that instant compete.
        """
        if self._current is None:
            start_ns = self._next_start_ns() if self._queue else until_ns
            if self._off and self._has_recovered(min(start_ns, until_ns)):
                return True
            if start_ns < until_ns:
                self._begin(start_ns)
        if self._current is None or self._end_ns > until_ns:
            self._pass_to(until_ns)
            return False
        self._pass_to(self._end_ns)
        self._finish(self._current)
        return True

    @property
    def total(self) -> WireLoad:
        """What the wire did since the beginning."""
        before, window = self._before, self._window
        return WireLoad(
            0,
            before.busy_ns + window.busy_ns,
            before.frames + window.frames,
            before.errors + window.errors,
            max(before.wait_max_ns, window.wait_max_ns),
        )

    def share(self, load: WireLoad) -> float:
        """Return the share of a window in which the wire was busy."""
        return load.busy_ns / self.window_ns

    def _pass_to(self, now_ns: int) -> None:
        if now_ns > self.now_ns:  # noqa: PLR1730 - for every frame
            self.now_ns = now_ns
        while now_ns >= self._window_end_ns:
            self._close_window()

    def _close_window(self) -> None:
        done = self.last = self._window
        self._before = self.total
        self._window = WireLoad(self._window_end_ns)
        self._window_end_ns += self.window_ns
        self.peak_share = max(self.peak_share, self.share(done))
        if self.on_window is not None:
            self.on_window(done)

    def _span_ns(self, bits: float) -> int:
        return round(bits * self._bit_ns)

    def _next_start_ns(self) -> int:
        """When the next frame starts; on a free bus, all that wait were sent just now."""
        ready_ns = self._queue[0][2]
        if self._has_counts:
            ready_ns = min([max(entry[2], entry[3].suspended_until_ns) for entry in self._queue])
        return ready_ns if ready_ns > self._free_ns else self._free_ns

    def _begin(self, start_ns: int) -> None:
        """Arbitrate among those that are ready now that the bus is free."""
        queue = self._queue
        if self._has_counts:
            queue = [entry for entry in queue if entry[3].suspended_until_ns <= start_ns]
        current = min(queue)
        self._queue.remove(current)
        self._current = current
        frame = current[4]
        if len(frame) == FRAME_SIZE:
            bits = frame_bits(frame)
            duration_ns = round(bits * self._bit_ns)
        else:
            first, second = fd_frame_bits(frame)
            bits = first + second
            duration_ns = round(first * self._bit_ns + second * self._data_bit_ns)
        self._start_ns = start_ns
        self._free_ns = start_ns + duration_ns
        self._end_ns = self._free_ns - self._interframe_ns
        self._is_disturbed = False
        if self._log_intact or current[3].failures_left:
            self._disturb(current[3], bits, duration_ns)
        for node in self._off:
            self._count_silence(node)

    def _finish(self, current: _Entry) -> None:
        self._current = None
        _, _, ready_ns, node, frame = current
        window = self._window
        window.busy_ns += self._free_ns - self._start_ns
        if self._is_disturbed:
            self._fail(current)
            return
        window.frames += 1
        wait_ns = self._start_ns - ready_ns
        if wait_ns > window.wait_max_ns:  # noqa: PLR1730 - for every frame
            window.wait_max_ns = wait_ns
        if self._has_counts:
            self._forgive(node)
        self._deliver(frame, node)

    # --- errors ------------------------------------------------------------------------------

    def _disturb(self, sender: CanController, bits: int, duration_ns: int) -> None:
        """Cut the frame that begins short if a disturbance hits one of its bits."""
        place = bits / 2 if sender.failures_left else math.inf
        if self._log_intact:
            first_hit = math.log(1.0 - self._random.random()) / self._log_intact
            place = min(place, math.floor(first_hit) + 1.0)
        if place > bits - INTERFRAME_BITS:
            return
        sender.failures_left -= sender.failures_left > 0
        self._is_disturbed = True
        has_active = any(not (node.is_passive or node.is_bus_off) for node in self._nodes)
        flag_bits = ERROR_FLAG_BITS if has_active else PASSIVE_FLAG_BITS
        hit_ns = self._start_ns + round(duration_ns * place / bits)
        self._end_ns = hit_ns + self._span_ns(flag_bits + ERROR_DELIMITER_BITS)
        self._free_ns = self._end_ns + self._interframe_ns

    def _fail(self, current: _Entry) -> None:
        """Everybody has seen an error frame: count, and let the sender try again."""
        sender = current[3]
        self._window.errors += 1
        self._has_counts = True
        if not sender.is_bus_off:
            self._queue.append(current)
        for node in [node for node in self._nodes if not node.is_bus_off]:
            node.count_error(is_sender=node is sender)
            if node.tec >= BUS_OFF_LIMIT:
                self._go_bus_off(node)
        self._suspend(sender)

    def _forgive(self, sender: CanController) -> None:
        """A frame came through: counters fall."""
        counting = [node for node in self._nodes if node.tec or node.rec]
        for node in counting:
            if not node.is_bus_off:
                node.count_success(is_sender=node is sender)
        self._has_counts = any(node.tec or node.rec for node in counting)
        self._suspend(sender)

    def _suspend(self, sender: CanController) -> None:
        if sender.is_passive:
            sender.suspended_until_ns = self._free_ns + self._span_ns(SUSPEND_BITS)

    # --- bus-off -----------------------------------------------------------------------------

    def _go_bus_off(self, node: CanController) -> None:
        self._drop_queue_of(node)
        self._off.append(node)
        node.sequences_left = RECOVERY_SEQUENCES
        node.recessive_ns = max(self._free_ns, self.now_ns)
        node.go_bus_off()

    def _recovers_at_ns(self, node: CanController) -> int:
        return node.recessive_ns + self._span_ns(SEQUENCE_BITS * node.sequences_left)

    def _next_recovery_ns(self) -> int | None:
        if not self._off or not self._is_recovering:
            return None
        return min([self._recovers_at_ns(node) for node in self._off])

    def _has_recovered(self, until_ns: int) -> bool:
        """Bring back a node that has seen enough silence before an instant, if there is one."""
        instant_ns = self._next_recovery_ns()
        if instant_ns is None or instant_ns >= until_ns:
            return False
        self._pass_to(instant_ns)
        node = min(self._off, key=self._recovers_at_ns)
        self._off.remove(node)
        node.rejoin()
        return True

    def _count_silence(self, node: CanController) -> None:
        """A frame begins: count the recessive bits before it; those at its end are the next."""
        silence_ns = self._start_ns - node.recessive_ns
        sequences = int(silence_ns / (SEQUENCE_BITS * self._bit_ns)) if silence_ns > 0 else 0
        node.sequences_left = max(0, node.sequences_left - sequences)
        node.recessive_ns = self._free_ns - self._span_ns(SEQUENCE_BITS)
