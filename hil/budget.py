"""The bus budget: what a cycle puts on the wire at worst, against what a period has room for.

Each bus of an arm has a budget of its own; what fits on one does not help another.

Lengths are worst-case ones, stuffed as densely as CAN allows (`drivers.frame`); what the families
send, their settings say (`AxisSettings.cycle_frames`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from drivers.frame import worst_case_bits, worst_case_fd_bits
from drivers.registry import axes_by_bus
from drivers.settings import AxisSettings, CycleFrame
from hil.config import BusSettings, Config, ConfigError

WARNING_SHARE = 0.8
"""Of the period; beyond it little room is left for repetitions and a late host."""
REMEDY = "use fewer axes, a longer period or a faster bus"


class BudgetLine(NamedTuple):
    """One kind of frame on the bus."""

    label: str
    """Whose frames they are."""
    frame: CycleFrame
    number: int
    """How many of them there can be in one cycle."""
    bits: int
    """Of one of them, at worst, interframe space included."""
    frame_s: float
    """How long one of them takes at worst."""

    @property
    def total_s(self) -> float:
        """What all of them take in one cycle."""
        return self.number * self.frame_s


@dataclass(frozen=True, slots=True)
class Budget:
    """Everything on one bus, per control period."""

    lines: tuple[BudgetLine, ...]
    period_s: float

    @property
    def cyclic_s(self) -> float:
        """What comes in every cycle."""
        return sum(line.total_s for line in self.lines if line.frame.every == 1)

    @property
    def reserve_s(self) -> float:
        """The longest of the frames that come now and then: one at most is let into a cycle.

        Those that lose arbitration to cyclic frames wait for the next cycle's gap.
        """
        return max((line.frame_s for line in self.lines if line.frame.every > 1), default=0.0)

    @property
    def share(self) -> float:
        """The share of the period that a cycle needs: all cyclic frames and the reserve."""
        return (self.cyclic_s + self.reserve_s) / self.period_s

    @property
    def peak_share(self) -> float:
        """The same if everything that comes now and then came at once."""
        return sum(line.total_s for line in self.lines) / self.period_s

    @property
    def mean_share(self) -> float:
        """The same over a long time."""
        return sum(line.total_s / line.frame.every for line in self.lines) / self.period_s

    @property
    def is_fitting(self) -> bool:
        """A cycle's frames have room in the period."""
        return self.share <= 1.0

    def as_json(self) -> dict[str, Any]:
        """Return everything as what JSON can hold."""
        frames = [
            {
                "frame": line.label,
                "count": line.number,
                "bits": line.bits,
                "total_s": line.total_s,
                "every": line.frame.every,
            }
            for line in self.lines
        ]
        shares = {
            "share": self.share,
            "mean_share": self.mean_share,
            "peak_share": self.peak_share,
        }
        return {"period_s": self.period_s, "frames": frames, **shares}

    def arithmetic(self) -> str:
        """Return the sum in words, in microseconds."""
        parts = [
            f"{line.number} x {line.label} {1e6 * line.frame_s:.0f}"
            for line in self.lines
            if line.frame.every == 1
        ]
        if self.reserve_s:
            parts.append(f"one other frame {1e6 * self.reserve_s:.0f}")
        needed_s = self.cyclic_s + self.reserve_s
        return f"{' + '.join(parts)} = {1e6 * needed_s:.0f} us"


def bus_budget(config: Config) -> Budget:
    """Return the budget of a configuration; of several buses, that of the fullest one."""
    return max(bus_budgets(config), key=lambda budget: budget.share)


def bus_budgets(config: Config) -> list[Budget]:
    """Return the budget of each bus, in the order of their numbers."""
    period_s = config.loop.period_s
    return [budget_of(axes, config.bus, period_s) for axes in axes_by_bus(config.axes)]


def budget_of(axes: Sequence[AxisSettings], bus: BusSettings, period_s: float) -> Budget:
    """Return the budget of some axes on one bus."""
    counts: dict[tuple[str, CycleFrame], int] = {}
    shared: dict[str, CycleFrame] = {}
    for axis in axes:
        family = getattr(axis, "family", "")
        for frame in axis.cycle_frames(period_s):
            if frame.is_shared:
                other = shared.get(frame.name, frame)
                shared[frame.name] = min(frame, other, key=lambda f: (f.every, -f.length))
            else:
                counts[(family, frame)] = counts.get((family, frame), 0) + 1
    counted = [((frame.name, frame), 1) for frame in shared.values()]
    counted += [((f"{family} {frame.name}", frame), n) for (family, frame), n in counts.items()]
    lines = [_line(label, frame, n, bus) for (label, frame), n in counted]
    return Budget(tuple(sorted(lines, key=lambda line: line.frame.every > 1)), period_s)


def _line(label: str, frame: CycleFrame, count: int, bus: BusSettings) -> BudgetLine:
    if not frame.is_fd:
        bits = worst_case_bits(frame.length, is_extended=frame.is_extended)
        return BudgetLine(label, frame, count, bits, bits / bus.bit_rate)
    first, second = worst_case_fd_bits(frame.length, is_extended=frame.is_extended)
    frame_s = first / bus.bit_rate + second / bus.data_bit_rate
    return BudgetLine(label, frame, count, first + second, frame_s)


def require_fit(config: Config) -> None:
    """Refuse a configuration whose cycle does not fit on one of its buses.

    Raises:
        ConfigError: With the arithmetic.
    """
    for number, budget in enumerate(bus_budgets(config), start=1):
        if not budget.is_fitting:
            which = f"bus {number}" if config.bus.more else "the bus"
            raise ConfigError(
                f"the cycle does not fit on {which}: {budget.arithmetic()} at worst "
                f"({100 * budget.share:.1f} %), the period has {1e6 * budget.period_s:.0f} us at "
                f"{config.bus.bit_rate} bit/s; {REMEDY}"
            )


def budget_table(budget: Budget) -> str:
    """Return the budget as lines for people."""
    rows: list[tuple[str, ...]] = [("frame", "count", "bits", "us", "share", "at most")]
    rows += [_row(line, budget.period_s) for line in budget.lines]
    sums = (
        ("cyclic", budget.cyclic_s / budget.period_s),
        ("one other frame", budget.reserve_s / budget.period_s),
        ("a cycle needs", budget.share),
        ("on average", budget.mean_share),
        ("all at once", budget.peak_share),
    )
    period_us = 1e6 * budget.period_s
    rows += [
        (name, "", "", f"{share * period_us:.1f}", f"{100 * share:.1f} %", "")
        for name, share in sums
    ]
    return "\n".join(_aligned(rows))


def _row(line: BudgetLine, period_s: float) -> tuple[str, ...]:
    share = 100 * line.total_s / period_s
    every = line.frame.every
    often = "every cycle" if every == 1 else f"every {every} cycles"
    taken_us = f"{1e6 * line.total_s:.1f}"
    return line.label, str(line.number), str(line.bits), taken_us, f"{share:.1f} %", often


def _aligned(rows: Sequence[Sequence[str]]) -> Iterable[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        first, *numbers, last = row
        middle = [cell.rjust(width) for cell, width in zip(numbers, widths[1:-1], strict=True)]
        yield "  ".join([first.ljust(widths[0]), *middle, last]).rstrip()
