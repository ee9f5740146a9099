"""SocketCAN: a raw `AF_CAN` socket on one interface (`can0`, `vcan0`).

Source: Linux kernel, Documentation/networking/can.rst, section 4.1 (RAW protocol sockets).
"""

import errno
import fcntl
import socket
import struct
from collections.abc import Collection, Iterable
from contextlib import suppress
from typing import NoReturn

from drivers.buses.kernel_socket import SocketBus
from drivers.errors import BusDownError, BusError
from drivers.frame import (
    EFF_FLAG,
    EFF_MASK,
    ERR_BIT,
    FD_FRAME_SIZE,
    FLAGS_INDEX,
    RTR_FLAG,
    SFF_MASK,
)

_AF_CAN = getattr(socket, "AF_CAN", 29)
_CAN_RAW = getattr(socket, "CAN_RAW", 1)
_SOL_CAN_RAW = getattr(socket, "SOL_CAN_RAW", 101)
_CAN_RAW_FILTER = getattr(socket, "CAN_RAW_FILTER", 1)
_CAN_RAW_ERR_FILTER = getattr(socket, "CAN_RAW_ERR_FILTER", 2)
_CAN_RAW_FD_FRAMES = getattr(socket, "CAN_RAW_FD_FRAMES", 5)
_ALL_ERRORS = struct.pack("=I", EFF_MASK)  # CAN_ERR_MASK
_FILTER = struct.Struct("=II")
_FILTERS_MAX = 512  # CAN_RAW_FILTER_MAX

_SIOCGIFMTU = 0x8921  # linux/sockios.h
_MTU_REQUEST = struct.Struct("=16si20x")  # struct ifreq

_RECEIVE_BYTES = 4 << 20
_SO_RCVBUFFORCE = 33  # asm-generic/socket.h; not in Python's socket module
_SO_MEMINFO = 55
_MEMINFO = struct.Struct("=9I")
_MEMINFO_DROPS = 8
_FRAMES_PER_CHECK = 64
_SIOCGSTAMPNS = 0x8907  # asm-generic/sockios.h
_TIMESPEC = struct.Struct("@ll")


class SocketCanBus(SocketBus):
    """One raw socket on one CAN interface.

    Error reports of the controller are subscribed to and come out of `recv` with `ERR_FLAG`.
    Frames that the kernel had to drop are found in `stats.receive_overflows` at the latest 64
    frames later: the socket's drop counter (`SO_MEMINFO`) is the one that `SO_RXQ_OVFL` attaches
    to each frame, but costs one call in 64 reads instead of a `recvmsg` for every one.

    A full queue of the interface (`ENOBUFS`) loses the frame, counted in `stats.send_failures`:
    lengthen it with `ip link set can0 txqueuelen 1000`.

    An interface that is taken down in use raises `BusDownError`, from `recv` once and from `send`
    every time; when it is up again, so is this bus.

    Raises:
        BusError: If the kernel has no CAN, or the interface is missing, is down, or is no CAN.
    """

    def __init__(self, interface: str) -> None:
        super().__init__(_open(interface))
        self.interface = interface
        self.carries_fd = _has_fd_mtu(self._socket, interface)

    def _take(self) -> bytes | None:
        try:
            frame = self._receive(FD_FRAME_SIZE)  # a classic frame is shorter
        except BlockingIOError:
            return None
        except OSError as error:
            self._raise_gone(error)
        stats = self.stats
        stats.frames_received += 1
        if frame[FLAGS_INDEX] & ERR_BIT:
            self._count_error_report()
        if not (stats.frames_received + stats.error_frames) % _FRAMES_PER_CHECK:
            self._count_overflows()
        return frame

    def _count_overflows(self) -> None:
        try:
            info = self._socket.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
            self.stats.receive_overflows = _MEMINFO.unpack(info)[_MEMINFO_DROPS]
        except (OSError, struct.error):
            pass  # a kernel before 4.12 cannot tell

    def arrival_ns(self) -> int | None:
        """Return when the kernel got the frame that `recv` returned last, None if it cannot tell.

        The time is the system clock's (`CLOCK_REALTIME`). It costs a call of its own
        (`SIOCGSTAMPNS`), and `recv` nothing. The first call makes the kernel take notes: it
        answers for frames that come after it.
        """
        try:
            stamp = fcntl.ioctl(self._socket.fileno(), _SIOCGSTAMPNS, bytes(_TIMESPEC.size))
        except (OSError, ValueError):  # nothing received yet, or closed
            return None
        seconds, nanoseconds = _TIMESPEC.unpack(stamp)
        return int(seconds) * 1_000_000_000 + int(nanoseconds)

    def accept(self, can_ids: Collection[int] | None) -> None:
        """Have the kernel drop all others, if it takes so many filters; see `Bus.accept`."""
        has_room = can_ids is None or len(can_ids) <= _FILTERS_MAX
        self.set_filters(can_ids if has_room else None)

    def set_filters(self, can_ids: Iterable[int] | None) -> None:
        """Let the kernel pass only data frames with these identifiers; None passes everything.

        Args:
            can_ids: Identifiers with flags: `EFF_FLAG` for 29 bits, `RTR_FLAG` for the remote
                request instead of the data frame. Error reports are always passed.

        Raises:
            BusError: If there are more than 512, or the socket is closed.
        """
        rules = [(0, 0)] if can_ids is None else [_exactly(can_id) for can_id in can_ids]
        if len(rules) > _FILTERS_MAX:
            raise BusError(f"{len(rules)} kernel filters asked for, at most {_FILTERS_MAX}")
        packed = b"".join(_FILTER.pack(*rule) for rule in rules)
        try:
            self._socket.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FILTER, packed)
        except OSError as error:
            self._raise_gone(error)

    def _raise_gone(self, error: Exception | None) -> NoReturn:
        if self._socket.fileno() < 0:
            raise BusError(f"the bus socketcan:{self.interface} is closed") from error
        is_down = isinstance(error, OSError) and error.errno == errno.ENETDOWN
        kind = BusDownError if is_down else BusError
        raise kind(_explain(self.interface, error)) from error


def _exactly(can_id: int) -> tuple[int, int]:
    mask = EFF_MASK if can_id & EFF_FLAG else SFF_MASK
    return can_id & (mask | EFF_FLAG | RTR_FLAG), mask | EFF_FLAG | RTR_FLAG


def _open(interface: str) -> socket.socket:
    try:
        endpoint = socket.socket(_AF_CAN, socket.SOCK_RAW, _CAN_RAW)
    except OSError as error:
        if error.errno not in {errno.EAFNOSUPPORT, errno.EPROTONOSUPPORT}:
            raise BusError(_explain(interface, error)) from error
        raise BusError(
            f"no bus socketcan:{interface}: this kernel has no CAN (AF_CAN); "
            "use unix:PATH or python-can:INTERFACE:CHANNEL"
        ) from error
    try:
        endpoint.setblocking(False)
        endpoint.setsockopt(_SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ALL_ERRORS)
        _take_fd_frames(endpoint)
        _enlarge_receive_queue(endpoint)
        endpoint.bind((interface,))
        pending = endpoint.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
        if pending:  # an interface that is down can be bound to
            raise OSError(pending, "")
    except OSError as error:
        endpoint.close()
        raise BusError(_explain(interface, error)) from error
    return endpoint


def _take_fd_frames(endpoint: socket.socket) -> None:
    """Receive and send CAN FD frames too; a kernel before 3.6 has none."""
    with suppress(OSError):
        endpoint.setsockopt(_SOL_CAN_RAW, _CAN_RAW_FD_FRAMES, 1)


def _has_fd_mtu(endpoint: socket.socket, interface: str) -> bool:
    """Tell whether the interface is set up for CAN FD: its MTU is that of the longer record."""
    request = _MTU_REQUEST.pack(interface.encode(), 0)
    try:
        mtu = int(_MTU_REQUEST.unpack(fcntl.ioctl(endpoint, _SIOCGIFMTU, request))[1])
    except OSError:
        return False
    return mtu >= FD_FRAME_SIZE


def _enlarge_receive_queue(endpoint: socket.socket) -> None:
    try:
        endpoint.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, _RECEIVE_BYTES)
    except OSError:  # without CAP_NET_ADMIN, as far as net.core.rmem_max goes
        endpoint.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BYTES)


def _explain(interface: str, error: Exception | None) -> str:
    number = error.errno if isinstance(error, OSError) else None
    name = f"no bus socketcan:{interface}"
    if number == errno.ENETDOWN:
        return f"{name}: the interface is down; `ip link set {interface} up`"
    if number == errno.EINVAL:  # what the kernel says to a frame longer than the MTU
        remedy = f"`ip link set {interface} mtu 72`, an adapter's with `type can ... fd on`"
        return f"{name}: {interface} is not set up for CAN FD frames; {remedy}"
    if number in {errno.ENODEV, errno.ENXIO}:
        remedy = "plug the adapter in, or `ip link add dev vcan0 type vcan; ip link set vcan0 up`"
        return f"{name}: there is no CAN interface {interface}; {remedy}"
    return f"{name}: {error}"
