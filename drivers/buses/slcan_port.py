"""The address of a serial CAN adapter, and its port as an open file descriptor."""

import errno
import fcntl
import os
import re
import termios
from dataclasses import dataclass
from typing import Self

from drivers.buses.slcan_codec import BIT_RATES_Hz
from drivers.errors import BusAddressError, BusError

BIT_RATE_Hz, BAUD_Hz = 1_000_000, 115_200
"""Taken when the address does not say."""

_FORM = "slcan:DEVICE[@BITRATE][,baud=N][,ack][,listen][,timestamps]"
_ADDRESS = re.compile(
    r"(?P<device>.+?)(?:@(?P<rate>\d+))?(?P<options>(?:,(?:baud=\d+|ack|listen|timestamps))*)"
)
_PTY = "pty="
_BAUDS = {  # Hz -> termios constant
    int(name[1:]): int(getattr(termios, name))
    for name in dir(termios)
    if re.fullmatch(r"B[1-9]\d+", name)
}


@dataclass(frozen=True, slots=True)
class SlcanAddress:
    """What follows `slcan:` in a bus address.

    Attributes:
        device: Path of the serial port or pty.
        bit_rate_Hz: Of the CAN bus; one of `BIT_RATES_Hz`.
        baud_Hz: Of the serial line; without meaning for USB-CDC adapters and ptys.
        has_acks: The adapter acknowledges every frame, and is held to it.
        is_listening: Open with `L`: nothing is sent, not even the acknowledge bit.
        has_timestamps: Ask for the adapter's time stamps (`Z1`).
    """

    device: str
    bit_rate_Hz: int = BIT_RATE_Hz
    baud_Hz: int = BAUD_Hz
    has_acks: bool = False
    is_listening: bool = False
    has_timestamps: bool = False

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read `DEVICE[@BITRATE][,baud=N][,ack][,listen][,timestamps]`.

        `pty=PATH` is accepted as a device, so that emulator and daemon can be given one line.

        Raises:
            BusAddressError: If the form, the bit rate or the serial speed is none there is.
        """
        match = _ADDRESS.fullmatch(text)
        device = match["device"].removeprefix(_PTY) if match else ""
        if not match or not device or device.startswith(","):
            raise BusAddressError(f"bus address 'slcan:{text}' is not {_FORM}")
        if device == "pty":
            raise BusAddressError(
                "bus address 'slcan:pty' is the emulator's; use the name that `hil emulate` "
                "printed, or give both sides one with slcan:pty=PATH"
            )
        options = match["options"].split(",")[1:]
        bauds = [int(option[5:]) for option in options if option.startswith("baud=")]
        rate_Hz = int(match["rate"] or BIT_RATE_Hz)
        baud_Hz = bauds[-1] if bauds else BAUD_Hz
        _check("CAN bit rate", rate_Hz, BIT_RATES_Hz, text)
        _check("serial speed", baud_Hz, _BAUDS, text)
        return cls(
            device, rate_Hz, baud_Hz, "ack" in options, "listen" in options, "timestamps" in options
        )


def _check(what: str, value_Hz: int, known: dict[int, bytes] | dict[int, int], text: str) -> None:
    if value_Hz not in known:
        usable = ", ".join(str(rate) for rate in sorted(known) if rate >= 9600)
        raise BusAddressError(
            f"bus address 'slcan:{text}': {what} {value_Hz} is not one of {usable}"
        )


def open_port(address: SlcanAddress) -> int:
    """Open the port raw, non-blocking, and for this program alone.

    Raises:
        BusError: If it is missing, no serial port, not permitted, or in use.
    """
    try:
        fd = os.open(address.device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC)
    except OSError as error:
        raise BusError(_explain(address.device, error)) from error
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        _make_raw(fd, _BAUDS[address.baud_Hz])
    except (OSError, termios.error) as error:
        os.close(fd)
        raise BusError(_explain(address.device, error)) from error
    return fd


def _make_raw(fd: int, speed: int) -> None:
    """8 data bits, no parity, no flow control, no translation (termios(3), raw mode)."""
    control = termios.tcgetattr(fd)[6]
    control[termios.VMIN], control[termios.VTIME] = 1, 0
    cflag = termios.CS8 | termios.CREAD | termios.CLOCAL
    termios.tcsetattr(fd, termios.TCSANOW, [0, 0, cflag, 0, speed, speed, control])
    termios.tcflush(fd, termios.TCIOFLUSH)


def _explain(device: str, error: Exception) -> str:
    number = error.args[0]
    name = f"no bus at slcan:{device}"
    if number == errno.ENOENT:
        return (
            f"{name}: no such file; plug the adapter in, or start `hil emulate --bus slcan:pty` "
            f"and use the name it prints ({_FORM})"
        )
    if number in {errno.EACCES, errno.EPERM}:
        return f"{name}: permission denied; join the port's group (dialout), or add a udev rule"
    if number in {errno.EAGAIN, errno.EBUSY}:
        return f"{name}: in use by another program; stop it first"
    if number in {errno.ENOTTY, errno.EISDIR, errno.EINVAL}:
        return f"{name}: this is no serial port"
    return f"{name}: {os.strerror(number) if isinstance(number, int) else error}"
