"""Errors of this room."""


class SimError(Exception):
    """Base of every error raised by `sim_backend`."""


class PlantError(SimError):
    """The simulated arm left the range in which its figures mean anything (NaN, torn joint)."""
