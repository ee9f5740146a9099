"""Log-scale histograms of durations, in memory that others may read while they grow.

The scale is linear up to 64 ns and then has 32 bins per octave, so that a quantile is never more
than 3.2 % above the true one. One process writes, any number read; each count is one aligned word,
so that nobody waits for anybody. A reader may see a value one count early or late, never a torn
one.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

LARGEST_NS: Final = (1 << 31) - 1
"""Longer durations are counted as this."""
_BITS: Final = 6
_PER_OCTAVE: Final = 1 << (_BITS - 1)
BINS: Final = (31 - _BITS) * _PER_OCTAVE + (1 << _BITS)
"""Number of bins."""
_MAX: Final = BINS  # the word after the bins
WORDS: Final = BINS + 1
"""Words of eight bytes that one histogram needs."""
QUANTILES: Final = (0.5, 0.99, 0.999)
QUANTILE_NAMES: Final = ("p50", "p99", "p99.9", "max")


def upper_edge_ns(bin_number: int) -> int:
    """Return the longest duration that is counted in a bin."""
    if bin_number < 1 << _BITS:
        return bin_number
    shift = bin_number // _PER_OCTAVE - 1
    return ((bin_number - shift * _PER_OCTAVE + 1) << shift) - 1


_EDGES_NS: Final[NDArray[np.int64]] = np.array([upper_edge_ns(n) for n in range(BINS)])


class Histogram:
    """One histogram of durations in ns.

    Args:
        memory: 8 * `WORDS` bytes, zero for an empty one; memory of its own if left out.

    Example:
        >>> histogram = Histogram()
        >>> for value_ns in (10, 20, 30):
        ...     histogram.add(value_ns)
        >>> histogram.quantiles_ns([0.5, 1.0])
        [20, 30]
    """

    __slots__ = ("_words",)

    def __init__(self, memory: memoryview | None = None) -> None:
        self._words = (memoryview(bytearray(8 * WORDS)) if memory is None else memory).cast("Q")

    def add(self, value_ns: int, times: int = 1) -> None:
        """Count a duration; negative ones count as 0, those above `LARGEST_NS` as that."""
        self.add_each(self._words, (value_ns,), times)

    @staticmethod
    def add_each(words: memoryview, values_ns: Sequence[int], times: int = 1) -> None:
        """Count one duration in each of several histograms that follow one another in memory.

        Args:
            words: Their memory as words of eight bytes, `WORDS` for each.
            values_ns: As many durations; see `add`, which a loop would have to call for each.
            times: How often each is counted.
        """
        start = 0
        for value_ns in values_ns:
            if value_ns < 64:
                at = value_ns if value_ns > 0 else 0
            else:
                if value_ns > LARGEST_NS:  # noqa: PLR1730 - a call costs as much as the rest
                    value_ns = LARGEST_NS  # noqa: PLW2901 - rarely taken
                shift = value_ns.bit_length() - _BITS
                at = shift * _PER_OCTAVE + (value_ns >> shift)
            words[start + at] += times
            if value_ns > words[start + _MAX]:  # noqa: PLR1730 - likewise
                words[start + _MAX] = value_ns
            start += WORDS

    def merge(self, other: "Histogram") -> None:
        """Count everything that another histogram has counted."""
        mine = np.frombuffer(self._words, dtype=np.int64)
        mine[:BINS] += other.counts()
        mine[_MAX] = max(self.max_ns, other.max_ns)

    @property
    def max_ns(self) -> int:
        """The longest duration so far, exactly."""
        return self._words[_MAX]

    def counts(self) -> NDArray[np.int64]:
        """Return a copy of all bins."""
        return np.frombuffer(self._words, dtype=np.int64)[:BINS].copy()

    def quantiles_ns(self, shares: Sequence[float] = QUANTILES) -> list[int]:
        """Return for each share the smallest bin edge that so many durations do not exceed.

        Args:
            shares: 0 to 1; 1 gives the exact maximum.

        Returns:
            As many durations in ns; none if the histogram is empty.
        """
        return quantiles_ns(self.counts(), shares, self.max_ns)

    def summary_us(self) -> dict[str, float]:
        """Return p50, p99, p99.9 and max in microseconds; empty before the first duration."""
        values_ns = self.quantiles_ns((*QUANTILES, 1.0))
        named = zip(QUANTILE_NAMES, values_ns, strict=False)
        return {name: round(value_ns / 1e3, 1) for name, value_ns in named}


def quantiles_ns(counts: NDArray[np.int64], shares: Sequence[float], most_ns: int) -> list[int]:
    """Return quantiles of binned durations, as `Histogram.quantiles_ns` does.

    Args:
        counts: Of each bin.
        shares: 0 to 1.
        most_ns: The longest duration, which no quantile exceeds.
    """
    sums = counts.cumsum()
    total = int(sums[-1])
    if total == 0:
        return []
    ranks = np.maximum(np.ceil(np.asarray(shares) * total), 1)
    at = np.searchsorted(sums, np.minimum(ranks, total))
    return [min(int(edge), most_ns) for edge in _EDGES_NS[at]]
