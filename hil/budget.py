"""The bus budget: what a cycle puts on the wire at worst, against what a period has room for."""

from collections.abc import Iterator

from drivers.frame import worst_case_bits
from hil.config import Config, ConfigError


def cycle_frames(config: Config) -> Iterator[tuple[str, int]]:
    """Yield every frame of one cycle and its worst-case length in bits, stuffing included."""
    yield "SYNC", worst_case_bits(0)
    for joint in range(1, config.joints + 1):
        yield f"joint {joint} RPDO1", worst_case_bits(4)
        yield f"joint {joint} TPDO1", worst_case_bits(8)


def bus_load(config: Config) -> tuple[int, float]:
    """Return the worst-case bits of one cycle, and their share of the period."""
    bits = sum(bits for _, bits in cycle_frames(config))
    return bits, bits / (config.bus.bit_rate * config.loop.period_s)


def require_fit(config: Config) -> None:
    """Refuse a configuration whose cycle does not fit on the bus.

    Raises:
        ConfigError: With the arithmetic.
    """
    bits, share = bus_load(config)
    if share <= 1.0:
        return
    parts = " + ".join(f"{name} {length}" for name, length in cycle_frames(config))
    room = config.bus.bit_rate * config.loop.period_s
    raise ConfigError(
        f"the cycle does not fit on the bus: {parts} = {bits} bits at worst, a period of "
        f"{1e3 * config.loop.period_s:g} ms at {config.bus.bit_rate} bit/s has {room:.0f}; use "
        "fewer axes, a longer period or a faster bus"
    )
