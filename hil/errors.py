"""Errors of this room. Library exceptions are translated into these at the boundary."""


class HilError(Exception):
    """Base of every error raised by `hil`."""
