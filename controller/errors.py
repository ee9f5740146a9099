"""Errors of this room."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from controller.reference import Violation


class ControllerError(Exception):
    """Base of every error raised by `controller`."""


class CommandError(ControllerError):
    """A command does not fit the state or the limits it was given to. Nothing has changed."""


class TrajectoryError(ControllerError):
    """A trajectory is not defined by what was given (shapes, times, rates)."""


class LimitError(TrajectoryError):
    """No motion of the asked kind stays within the limits.

    Attributes:
        violation: What the attempt that came closest went beyond.
    """

    def __init__(self, violation: "Violation") -> None:
        super().__init__(str(violation))
        self.violation = violation
