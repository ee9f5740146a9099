"""The Unix bus as a python-can interface: `can.Bus(interface="hil-unix", channel=PATH)`.

With it `can.logger`, `can.viewer`, `canopen` and `cantools monitor` attach to a running emulator.
"""

import select
from time import monotonic, time
from typing import NoReturn

import can

from drivers.buses.python_can import from_message, to_message
from drivers.buses.unix import UnixBus
from drivers.errors import BusError
from drivers.frame import is_fd

_LONG_S = 3600.0  # python-can asks again when a wait without end comes back empty


class HilUnixBus(can.BusABC):
    """A python-can bus on the emulator's hub.

    Args:
        channel: Path of the hub's socket, as in the bus address `unix:PATH`.
        can_filters: python-can's filters, applied in software.
        receive_own_messages: Not possible here; `True` is refused.
        fd: CAN FD frames pass both ways. Without it they do not come, and are refused, as
            python-can's socketcan has it.
        **kwargs: Options of other interfaces (a bit rate, for example) have no meaning here.

    Raises:
        can.CanInitializationError: If no emulator listens at `channel`.
    """

    def __init__(
        self,
        channel: str,
        can_filters: can.typechecking.CanFilters | None = None,
        *,
        receive_own_messages: bool = False,
        fd: bool = False,
        **kwargs: object,
    ) -> None:
        if receive_own_messages:
            raise can.CanInitializationError(
                "hil-unix carries frames without echo: no receive_own_messages"
            )
        try:
            self._bus = UnixBus(str(channel))
        except BusError as error:
            raise can.CanInitializationError(str(error)) from error
        self._state = can.BusState.ACTIVE
        self._is_fd = fd
        self._can_protocol = can.CanProtocol.CAN_FD if fd else can.CanProtocol.CAN_20
        self._channel = str(channel)
        self.channel_info = f"hil-unix {channel}"
        super().__init__(channel, can_filters, **kwargs)  # last: from here on it counts as open

    def send(self, msg: can.Message, timeout: float | None = None) -> None:
        """Send one message; if the hub's queue is full, wait for room.

        Args:
            msg: A classic message, or with `fd` a CAN FD one.
            timeout: Longest wait in seconds; None waits without end, 0 not at all.

        Raises:
            can.CanTimeoutError: If there was no room in time. The message is not sent.
            can.CanOperationError: If the message is no CAN frame, or the emulator has gone.
        """
        if msg.is_fd and not self._is_fd:
            raise can.CanOperationError(f"the bus was opened without fd=True, not sent: {msg}")
        frame = from_message(msg)
        if frame is None:
            raise can.CanOperationError(f"not a CAN frame, not sent: {msg}")
        deadline_s = None if timeout is None else monotonic() + timeout
        try:
            while not self._bus.send(frame):
                self._await_room(deadline_s)
        except BusError as error:
            self._fail(error)

    def _await_room(self, deadline_s: float | None) -> None:
        left_s = _LONG_S if deadline_s is None else deadline_s - monotonic()
        if left_s > 0.0 and select.select((), (self._bus,), (), left_s)[1]:
            return
        if deadline_s is not None:
            raise can.CanTimeoutError("the emulator does not read: message not sent")

    def _recv_internal(self, timeout: float | None) -> tuple[can.Message | None, bool]:
        left_s = _LONG_S if timeout is None else timeout
        deadline_s = monotonic() + left_s
        try:
            frame = self._bus.recv(left_s)
            while frame is not None and is_fd(frame) and not self._is_fd:
                frame = self._bus.recv(max(0.0, deadline_s - monotonic()))
        except BusError as error:
            self._fail(error)
        if frame is None:
            return None, False
        return to_message(frame, timestamp_s=time(), channel=self._channel), False

    def _fail(self, error: BusError) -> NoReturn:
        self._state = can.BusState.ERROR
        raise can.CanOperationError(str(error)) from error

    def fileno(self) -> int:
        """Descriptor that is readable when a message waits; nothing is buffered behind it."""
        return self._bus.fileno()

    @property
    def state(self) -> can.BusState:
        """ACTIVE, or ERROR once the emulator has gone."""
        return self._state

    @state.setter
    def state(self, new_state: can.BusState) -> None:
        raise NotImplementedError("the state of hil-unix follows the emulator")

    def shutdown(self) -> None:
        """Leave the bus. Idempotent."""
        super().shutdown()
        self._bus.close()
