"""The emulated ODrive's parameters: the few that CANSimple's rates and limits need."""

import math
from collections.abc import Callable
from struct import Struct, error
from typing import Any

from drivers.odrive.codec import F32, OPCODE_READ, OPCODE_WRITE, Sdo
from drivers.odrive.endpoints import (
    INJECT_FAULT_ID,
    LAYOUT,
    TIME_BASE_ID,
    Endpoint,
    EndpointTable,
)
from sim_backend.odrive.axis import OdriveAxisModel

DEFAULT_RATES = {Endpoint.HEARTBEAT_RATE: 100, Endpoint.ENCODER_RATE: 10, Endpoint.TORQUES_RATE: 0}
"""Milliseconds between cyclic messages, 0 = never, until they are written."""
_PLACES = {  # endpoint -> (attribute of the axis that owns it, or the axis itself; attribute)
    Endpoint.WATCHDOG_TIMEOUT: ("", "watchdog_timeout_s"),
    Endpoint.ENABLE_WATCHDOG: ("", "is_watchdog_on"),
    Endpoint.CURRENT_SOFT_MAX: ("", "current_soft_max_A"),
    Endpoint.TORQUE_CONSTANT: ("", "torque_constant_Nm_A"),
    Endpoint.TORQUE_SOFT_MIN: ("controller", "torque_min_Nm"),
    Endpoint.TORQUE_SOFT_MAX: ("controller", "torque_max_Nm"),
    Endpoint.VEL_LIMIT: ("controller", "vel_limit_rev_s"),
    Endpoint.TORQUE_MODE_VEL_LIMIT: ("controller", "is_torque_mode_limited"),
}
_FIXED = Endpoint.TORQUE_CONSTANT


class Parameters:
    """Values by endpoint, kept in the axis where they act.

    Args:
        axis: Whose parameters.
        table: The numbers under which they are asked for.
        is_lockstep: What the emulator's own endpoint tells.
        on_fault: Called when the emulator's own fault endpoint is written.

    Attributes:
        rates_ms: Of the cyclic messages.
    """

    def __init__(
        self,
        axis: OdriveAxisModel,
        table: EndpointTable,
        *,
        is_lockstep: bool,
        on_fault: Callable[[], None],
    ) -> None:
        self.rates_ms = dict(DEFAULT_RATES)
        self._axis = axis
        self._by_id = {number: endpoint for endpoint, number in table.ids.items()}
        self._is_lockstep = is_lockstep
        self._on_fault = on_fault
        self._defaults = self._saved = self._all()

    def exchange(self, sdo: Sdo) -> bytes | None:
        """Carry out an access; return the value that was read, None if there is no answer.

        An endpoint that does not exist, or too few bytes to write, is ignored.
        """
        if sdo.opcode == OPCODE_WRITE:
            self._write(sdo)
            return None
        if sdo.opcode != OPCODE_READ:
            return None
        if sdo.endpoint == TIME_BASE_ID:
            return bytes((self._is_lockstep,))
        endpoint = self._by_id.get(sdo.endpoint)
        return None if endpoint is None else _pack(LAYOUT[endpoint], self._get(endpoint))

    def save(self) -> None:
        """Keep the values over a restart."""
        self._saved = self._all()

    def erase(self) -> None:
        """Forget what was saved; takes effect with the restart that follows."""
        self._saved = self._defaults

    def restore(self) -> None:
        """Set the values that were saved, as after a restart."""
        for endpoint, value in self._saved.items():
            self._set(endpoint, value)

    def _all(self) -> dict[Endpoint, Any]:
        return {endpoint: self._get(endpoint) for endpoint in Endpoint}

    def _write(self, sdo: Sdo) -> None:
        if sdo.endpoint == INJECT_FAULT_ID:
            self._on_fault()
            return
        endpoint = self._by_id.get(sdo.endpoint)
        if endpoint is None:
            return
        try:
            (value,) = LAYOUT[endpoint].unpack_from(sdo.value)
        except error:
            return
        self._set(endpoint, value)

    def _get(self, endpoint: Endpoint) -> Any:  # noqa: ANN401 - bool, int or float
        if endpoint in self.rates_ms:
            return self.rates_ms[endpoint]
        owner, name = _PLACES[endpoint]
        return getattr(getattr(self._axis, owner) if owner else self._axis, name)

    def _set(self, endpoint: Endpoint, value: Any) -> None:  # noqa: ANN401 - bool, int or float
        if endpoint in self.rates_ms:
            self.rates_ms[endpoint] = value
        elif endpoint is not _FIXED:
            owner, name = _PLACES[endpoint]
            setattr(getattr(self._axis, owner) if owner else self._axis, name, value)


def _pack(layout: Struct, value: Any) -> bytes:  # noqa: ANN401 - bool, int or float
    """Pack a value; single precision is infinite where the value is beyond it."""
    try:
        return layout.pack(value)
    except OverflowError:
        return F32.pack(math.copysign(math.inf, value))
