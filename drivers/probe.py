"""Finds amplifiers that answer a whole period late: their answers look as if they were in time.

After a gap one cycle goes by without a request, a probe. Whoever answers in it answers an older
request. From then on complete cycles are not believed: ages grow on, and the answers count as
late, until two probes at different distances have passed in silence (one alone may meet the hole
that an earlier probe left). A first complete cycle after a gap is believed, because mostly the
frame was just lost.
"""

from collections.abc import Sequence

from drivers.axis import Axis

EVERY_CYCLES = 50
"""Without suspicion, probes are at least so far apart, whatever is lost."""


class Probe:
    """Judges the answers of the axes that are asked; those that send by their own clock go free.

    Attributes:
        is_due: The next cycle is to ask nobody.
        is_at_ease: There was no gap and there is no suspicion: answers are what they seem.
    """

    __slots__ = (
        "_ages",
        "_asked",
        "_has_gap",
        "_late",
        "_passes_needed",
        "_since",
        "_to_next",
        "is_at_ease",
        "is_due",
    )

    def __init__(self) -> None:
        self._asked: list[Axis] = []
        self._ages: list[int] = []
        self._late: list[Axis] = []
        self._has_gap = self.is_due = False
        self._passes_needed = self._to_next = 0
        self._since = EVERY_CYCLES
        self.is_at_ease = True

    def watch(self, axes: Sequence[Axis]) -> None:
        """Watch these axes, once they are configured."""
        self._asked = [axis for axis in axes if axis.is_asked]

    def note_gap(self) -> None:
        """Not everybody has answered in this cycle."""
        if self._asked:
            self._has_gap, self.is_at_ease = True, False
            self._count()

    def note_ages(self) -> None:
        """Remember how old all feedback is before this cycle's comes in."""
        self._ages = [axis.age_cycles for axis in self._asked]

    def believe(self) -> int:
        """Judge a cycle in which all have answered.

        Returns:
            0 if the answers are believed; else how many are not, their ages put back.
        """
        self._count()
        if not self._late:
            self.is_due = self._since >= EVERY_CYCLES
        self._put_back(self._late)
        return len(self._late)

    def judge(self) -> int:
        """Judge a probe; return the number of axes that answered although nobody asked."""
        ages = zip(self._asked, self._ages, strict=True)
        late = [axis for axis, age in ages if axis.age_cycles < age]
        self.is_due = self._has_gap = False
        self._since = 0
        if late:
            self._late, self._passes_needed, self._to_next = late, 2, 1
            for axis in late:
                axis.note = f"{axis.label}: answers a period late,"
            self._put_back(late)
        elif self._late:
            self._passes_needed, self._to_next = self._passes_needed - 1, 2
            if not self._passes_needed:
                self._late = []
        self.is_at_ease = not self._late
        return len(late)

    def _count(self) -> None:
        """One more cycle without ease."""
        self._since += 1
        if self._late:
            self._to_next -= 1
            self.is_due = self._to_next <= 0

    def _put_back(self, axes: Sequence[Axis]) -> None:
        for axis, age in zip(self._asked, self._ages, strict=True):
            if axis in axes:
                axis.age_cycles = age
