"""What is done about feedback that is late or missing, rung by rung, and how often it was."""

LATE_SHARE = 0.5
"""Of the time for feedback; what takes longer and is still in time counts as late."""


class Ladder:
    """Counters of the rungs of one arm; what happens on each, `Control` says.

    Attributes:
        late_after_ns: Feedback that takes longer than this from the request on is late.
        late: Cycles with feedback that was late, but there at its deadline: it was used.
        held: Cycles under power without feedback in which the last torque was sent again.
        damped: Cycles under power without feedback in which the torque only damped: each axis that
            still answers against its own motion, no torque on those that are silent.
        given_up: Times that feedback stayed away for longer: torque off and `FEEDBACK_LOST`.
    """

    __slots__ = ("damped", "given_up", "held", "late", "late_after_ns")

    def __init__(self, timeout_s: float) -> None:
        """Start at zero.

        Args:
            timeout_s: The time for feedback, from a cycle's start on.
        """
        self.late_after_ns = round(LATE_SHARE * timeout_s * 1e9)
        self.late = self.held = self.damped = self.given_up = 0

    def counts(self) -> dict[str, int]:
        """Return the counters by name, mildest rung first."""
        return {
            "late": self.late,
            "held": self.held,
            "damped": self.damped,
            "given_up": self.given_up,
        }
