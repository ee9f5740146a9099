"""Errors of this room. Library exceptions are translated into these at the boundary."""


class DriverError(Exception):
    """Base of every error raised by `drivers`."""


class BusError(DriverError):
    """A bus could not be opened, or failed while in use."""


class BusDownError(BusError):
    """The bus is not there now but may come back: the same `Bus` then works again."""


class BusAddressError(BusError):
    """A bus address could not be understood; the message names the forms that can."""


class AmplifierError(DriverError):
    """An amplifier did not answer, refused a setting, or disagrees with the configuration."""
