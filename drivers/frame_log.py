"""Frames in files, in python-can's formats: candump `.log`, Vector `.asc` and `.blf`."""

import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Self

import can
from can.io.generic import MessageReader, MessageWriter

from drivers.buses.python_can import from_message, to_message
from drivers.errors import DriverError

_BLF_OBJECT = struct.Struct("<4sHHI")
"""Head of an object in a BLF container: `LOBJ`, size of the head, its version, size of all."""
_BLF_PADDING_MAX = 8


class _BlfReader(can.BLFReader):
    """python-can's reader, without standing still at a damaged object that says it has no size."""

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        place = data.find(b"LOBJ")
        while 0 <= place <= len(data) - _BLF_OBJECT.size:
            size = _BLF_OBJECT.unpack_from(data, place)[3]
            if size < _BLF_OBJECT.size:
                raise ValueError(f"an object of {size} bytes")
            place = data.find(b"LOBJ", place + size, place + size + _BLF_PADDING_MAX)
        return super()._parse_data(data)


_READERS: dict[str, tuple[str, Callable[..., MessageReader]]] = {  # suffix -> file mode, reader
    ".log": ("r", can.CanutilsLogReader),
    ".asc": ("r", can.ASCReader),
    ".blf": ("rb", _BlfReader),
}
SUFFIXES = tuple(_READERS)
_BROKEN = (
    ValueError, LookupError, TypeError, AttributeError, EOFError, OverflowError,
    struct.error, zlib.error, can.CanError, can.io.blf.BLFParseError,
)  # fmt: skip
"""What python-can's readers raise for a file that is not of its format."""


class FrameLogError(DriverError):
    """A log cannot be written or read; the message names the file and the reason."""


def require_suffix(path: Path) -> None:
    """Refuse a file name that names no format.

    Raises:
        FrameLogError: With the suffixes that do.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise FrameLogError(
            f"{path}: the suffix chooses the format: .log (candump), .asc (Vector ASC) or .blf"
        )


class FrameLogWriter:
    """Writes frames to a file; the suffix chooses the format. Use it in a `with` block.

    Args:
        path: Ends in .log, .asc or .blf.
        channel: Name of the bus in the file, without spaces.

    Raises:
        FrameLogError: If the suffix is another one, or the file cannot be written.
    """

    def __init__(self, path: Path, channel: str = "can0") -> None:
        require_suffix(path)
        self.path = path
        self.frames = 0
        self._channel = channel
        try:
            self._writer: MessageWriter = can.Logger(path)
        except OSError as error:
            raise FrameLogError(f"{path}: {error.strerror or error}") from error

    def write(self, frame: bytes, t_s: float, *, is_sent: bool = False) -> None:
        """Append one frame.

        Args:
            frame: Record as on a bus.
            t_s: Seconds since the epoch.
            is_sent: It went out from here, where the format has a place for that.

        Raises:
            FrameLogError: If the file cannot be written to.
        """
        message = to_message(frame, timestamp_s=t_s, channel=self._channel)
        message.is_rx = not is_sent
        try:
            self._writer.on_message_received(message)
        except OSError as error:
            raise FrameLogError(f"{self.path}: {error.strerror or error}") from error
        self.frames += 1

    def close(self) -> None:
        """Write what is buffered and close the file. Idempotent."""
        with suppress(ValueError):  # closed already
            self._writer.stop()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()


def read_log(path: Path) -> Iterator[tuple[float, bytes]]:
    """Yield (seconds, record) of every frame in a log, in the file's order.

    Error reports are records with `ERR_FLAG`; what the records cannot hold is left out.

    Raises:
        FrameLogError: If there is no such file, or it is not what its suffix says.
    """
    require_suffix(path)
    mode, reader = _READERS[path.suffix.lower()]
    try:
        with path.open(mode) as file:  # a reader that fails leaves its own file open
            for message in reader(file):
                frame = from_message(message)
                if frame is not None:
                    yield message.timestamp, frame
    except OSError as error:
        raise FrameLogError(f"{path}: {error.strerror or error}") from error
    except _BROKEN as error:
        raise FrameLogError(f"{path}: not a {path.suffix} log: {error}") from error
