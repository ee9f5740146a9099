"""The emulator's side of slcan: a pty that behaves as a serial adapter on the emulated wire."""

import errno
import os
import select
import socket
import tty
from collections.abc import Callable
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from time import monotonic, monotonic_ns, sleep
from typing import NoReturn

from drivers.buses.slcan_codec import (
    LineSplitter,
    StatusFlags,
    TIMESTAMP_WRAP_ms,
    encode_frame,
    encode_report,
)
from drivers.buses.slcan_port import SlcanAddress
from drivers.errors import BusAddressError
from drivers.frame import ERR_BIT, FLAGS_INDEX
from sim_backend.errors import SimError
from sim_backend.hub import ClientStats, Wire
from sim_backend.slcan_adapter import REFUSED, SlcanAdapter

QUEUE_BYTES = 64 << 10
"""Lines that wait in the adapter for a host that does not read; the kernel holds 20 KB more."""

_READ_BYTES = 4096
_NOBODY_S = 2e-3  # a pty nobody has open is always readable: ask it now and then
_MODE = 0o660
_PTS = "/dev/pts/"
_ACK = ",ack"


class SlcanPty(Wire):
    """An adapter on a pty, and the host program that opens it as its serial port.

    The channel closes when the host leaves, and the next one begins anew. A host that does not
    read loses frames, counted in `stats`; it never holds up the emulator.

    Args:
        rest: `pty[=LINK][,ack]`: LINK is a symbolic link to keep to the pty while it exists;
            `ack` has every frame acknowledged with `z` or `Z`. What else the daemon's address
            may say is taken, too: both sides can be given the same line.
        now_ns: Clock of the time stamps.

    Attributes:
        address: Bus address at which the host finds the adapter.
        name: Path of the pty itself.
        stats: Frames from and to the host.

    Raises:
        SimError: If there is no pty to be had, or the link cannot be made.
    """

    def __init__(self, rest: str = "pty", *, now_ns: Callable[[], int] = monotonic_ns) -> None:
        link, has_acks = _parse(rest)
        self.stats = ClientStats()
        self.adapter = SlcanAdapter(has_acks=has_acks)
        self._now_ns = now_ns
        self._lines = LineSplitter()
        self._queue = b""
        self._fd, self.name = _open_pty()
        self._is_alone = True
        self._link: _Link | None = None
        try:
            self._link = _Link(link, self.name) if link else None
        except SimError:
            os.close(self._fd)
            raise
        self.address = f"slcan:{link or self.name}"

    def transmit(self, frame: bytes) -> None:
        """Pass a frame from the wire to the host, if its channel is open; see `Wire.transmit`.

        CAN FD frames have no line: lost for the host, and counted.
        """
        if self._fd < 0:
            self._raise_closed()
        adapter = self.adapter
        if frame[FLAGS_INDEX] & ERR_BIT:
            adapter.note_report(frame)
            line = encode_report(frame)
        else:
            line = encode_frame(frame)
            if adapter.has_timestamps and line:
                line = self._stamp(line)
        if not adapter.is_open:
            return
        if not line or len(self._queue) + len(line) > QUEUE_BYTES:
            adapter.flags |= StatusFlags.RECEIVE_FULL | StatusFlags.DATA_OVERRUN
            self.stats.frames_lost += 1
            return
        self._put(line)

    def wait(self, timeout_s: float) -> list[bytes]:
        """Return the host's frames; see `Wire.wait`."""
        deadline_s = monotonic() + timeout_s
        while True:
            if self._queue:
                self._put(b"")
            frames = self._take() if self._is_readable(max(0.0, timeout_s)) else []
            timeout_s = deadline_s - monotonic()
            if frames or timeout_s <= 0.0:
                return frames
            if self._is_alone:
                sleep(min(timeout_s, _NOBODY_S))

    def close(self) -> None:
        """Hang up on the host and remove the link."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
            if self._link is not None:
                self._link.remove()

    def _raise_closed(self) -> NoReturn:
        raise SimError(f"the bus at {self.address} is closed")

    def _stamp(self, line: bytes) -> bytes:
        stamp_ms = self._now_ns() // 1_000_000 % TIMESTAMP_WRAP_ms
        return b"%b%04X\r" % (line[:-1], stamp_ms)

    def _put(self, data: bytes) -> None:
        """Write, after what is queued; what the pty does not take stays queued."""
        data = self._queue + data
        try:
            written = os.write(self._fd, data)
        except OSError:  # full, or the host has just left, which `_take` finds out
            written = 0
        self._queue = data[written:]

    def _is_readable(self, timeout_s: float) -> bool:
        """Wait for something to read, or for room to write what is queued."""
        port = (self._fd,)
        try:
            return bool(select.select(port, port if self._queue else (), (), timeout_s)[0])
        except ValueError:
            self._raise_closed()

    def _take(self) -> list[bytes]:
        """Read what the host has written, and answer it."""
        try:
            chunk = os.read(self._fd, _READ_BYTES)
        except OSError as error:
            if error.errno == errno.EIO:
                self._hang_up()
            return []
        self._is_alone = False
        lines = self._lines.feed(chunk)
        answers = [REFUSED] * self._lines.overlong
        self._lines.overlong = 0
        frames = []
        for line in lines:
            answer, frame = self.adapter.take(line)
            if answer:
                answers.append(answer)
            if frame is not None:
                frames.append(frame)
        self.stats.frames_received += len(frames)
        if answers:
            self._answer(answers)
        return frames

    def _answer(self, answers: list[bytes]) -> None:
        self.stats.malformed_records += answers.count(REFUSED)
        if len(self._queue) < QUEUE_BYTES:  # else the host does not read: it gets no answers
            self._put(b"".join(answers))

    def _hang_up(self) -> None:
        """There is no host, or it has left."""
        self._is_alone = True
        self.adapter.hang_up()
        self._lines.reset()
        self._queue = b""


def _parse(rest: str) -> tuple[str, bool]:
    """Return the link asked for (nothing without one), and whether frames are acknowledged."""
    if rest.removesuffix(_ACK) == "pty":
        return "", rest != "pty"
    if not rest.startswith("pty="):
        raise SimError(f"bus address 'slcan:{rest}' is not slcan:pty[=LINK][,ack]")
    try:
        address = SlcanAddress.parse(rest)
    except BusAddressError as error:
        raise SimError(str(error)) from error
    return address.device, address.has_acks


def _open_pty() -> tuple[int, str]:
    """Return the adapter's end of a new pty, raw and non-blocking, and the name of the host's."""
    try:
        fd, host_fd = os.openpty()
    except OSError as error:
        raise SimError(f"no pty to be had for slcan:pty: {error.strerror or error}") from error
    try:
        tty.setraw(host_fd)  # or the pty would echo what the adapter says
        os.fchown(host_fd, -1, os.getegid())
        os.fchmod(host_fd, _MODE)
        os.set_blocking(fd, False)
        return fd, os.ttyname(host_fd)
    finally:
        os.close(host_fd)  # from now on its owner is the host


class _Link:
    """A fixed name for the pty. One emulator at a time keeps it, known by an abstract socket."""

    def __init__(self, path: str, target: str) -> None:
        self._path = Path(path)
        self._target = target
        self._lock = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        try:
            self._lock.bind(b"\0hil-slcan-" + sha256(str(self._path.absolute()).encode()).digest())
            self._make()
        except OSError as error:
            self._lock.close()
            raise SimError(self._explain(error)) from error

    def _make(self) -> None:
        """Put the link in place at once, over one that an emulator killed has left."""
        path = self._path
        is_ours = path.is_symlink() and str(path.readlink()).startswith(_PTS)
        if os.path.lexists(path) and not is_ours:
            raise FileExistsError(errno.EEXIST, "a file that is no link to a pty is in the way")
        fresh = path.with_name(f".{path.name}.{os.getpid()}")
        fresh.symlink_to(self._target)
        fresh.replace(path)

    def _explain(self, error: OSError) -> str:
        if error.errno == errno.EADDRINUSE:
            return f"another emulator already offers a pty at {self._path}"
        if not self._path.parent.is_dir():
            return f"no directory {self._path.parent} for slcan:pty={self._path}; create it first"
        return f"cannot link the pty to {self._path}: {error.strerror or error}"

    def remove(self) -> None:
        """Remove the link, unless it is somebody else's by now."""
        with suppress(OSError):
            if str(self._path.readlink()) == self._target:
                self._path.unlink()
        self._lock.close()
