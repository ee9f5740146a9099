"""Parameters of an ODrive by name: their types, and their numbers, which differ by firmware.

The vendor publishes the numbers of each firmware and board as `flat_endpoints.json`.
Source: ODrive documentation "CAN Protocol", Arbitrary Parameter Access; can_param_access.py.
"""

import json
from enum import StrEnum
from pathlib import Path
from struct import Struct
from typing import Any, NamedTuple

from drivers.errors import AmplifierError
from drivers.odrive.codec import F32, OPCODE_READ, OPCODE_WRITE, U32, Sdo, pack_sdo

BOOL = Struct("<?")


class Endpoint(StrEnum):
    """The parameters in use here, by the vendor's path."""

    WATCHDOG_TIMEOUT = "axis0.config.watchdog_timeout"
    ENABLE_WATCHDOG = "axis0.config.enable_watchdog"
    TORQUE_SOFT_MIN = "axis0.config.torque_soft_min"
    TORQUE_SOFT_MAX = "axis0.config.torque_soft_max"
    TORQUE_CONSTANT = "axis0.config.motor.torque_constant"
    CURRENT_SOFT_MAX = "axis0.config.motor.current_soft_max"
    HEARTBEAT_RATE = "axis0.config.can.heartbeat_msg_rate_ms"
    ENCODER_RATE = "axis0.config.can.encoder_msg_rate_ms"
    TORQUES_RATE = "axis0.config.can.torques_msg_rate_ms"
    VEL_LIMIT = "axis0.controller.config.vel_limit"
    TORQUE_MODE_VEL_LIMIT = "axis0.controller.config.enable_torque_mode_vel_limit"


LAYOUT: dict[Endpoint, Struct] = {
    Endpoint.WATCHDOG_TIMEOUT: F32,
    Endpoint.ENABLE_WATCHDOG: BOOL,
    Endpoint.TORQUE_SOFT_MIN: F32,
    Endpoint.TORQUE_SOFT_MAX: F32,
    Endpoint.TORQUE_CONSTANT: F32,
    Endpoint.CURRENT_SOFT_MAX: F32,
    Endpoint.HEARTBEAT_RATE: U32,
    Endpoint.ENCODER_RATE: U32,
    Endpoint.TORQUES_RATE: U32,
    Endpoint.VEL_LIMIT: F32,
    Endpoint.TORQUE_MODE_VEL_LIMIT: BOOL,
}
"""How each value is packed."""

_TYPES = {"bool": BOOL, "uint32": U32, "float": F32}

TIME_BASE_ID = 0xFFF1
"""Emulated drive only: bool, plant time follows the master's lockstep frame. Beyond the numbers of
any firmware, so that a real drive does not answer."""
INJECT_FAULT_ID = 0xFFF0
"""Emulated drive only: writing anything faults the drive. A real one ignores it."""
EMULATED_SERIAL = int.from_bytes(b"HIL", "little")
"""Low 24 bits of an emulated drive's serial number: who has them is asked for `TIME_BASE_ID`."""


def emulated_serial(node: int) -> int:
    """Return the 48-bit serial number of the emulated drive with this node id."""
    return node << 24 | EMULATED_SERIAL


class EndpointTable(NamedTuple):
    """The numbers of one firmware on one board."""

    firmware: tuple[int, int, int]
    hardware: tuple[int, int, int]
    ids: dict[Endpoint, int]

    def read(self, endpoint: Endpoint) -> bytes:
        """Payload of 0x04 that asks for a value."""
        return pack_sdo(Sdo(OPCODE_READ, self.ids[endpoint], b""))

    def write(self, endpoint: Endpoint, value: float) -> bytes:
        """Payload of 0x04 that sets a value."""
        return pack_sdo(Sdo(OPCODE_WRITE, self.ids[endpoint], LAYOUT[endpoint].pack(value)))


EMULATED = EndpointTable(
    firmware=(0, 6, 10),
    hardware=(0, 0, 0),
    ids={endpoint: 0xFE00 + number for number, endpoint in enumerate(Endpoint)},
)
"""Of the emulated drive, unless it is told another one's. There is no board 0.0.0."""


def load_endpoints(path: str) -> EndpointTable:
    """Read the vendor's `flat_endpoints.json`.

    Raises:
        AmplifierError: If it cannot be read, or lacks what is needed here.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
        return EndpointTable(
            firmware=_version(content["fw_version"].partition("-")[0]),
            hardware=_version(content["hw_version"]),
            ids={endpoint: _number(content["endpoints"], endpoint) for endpoint in Endpoint},
        )
    except OSError as error:
        raise AmplifierError(f"{path}: {error.strerror or error}") from error
    except KeyError as error:
        raise AmplifierError(f"{path}: {error} is missing; use the vendor's file") from error
    except (ValueError, TypeError, AttributeError) as error:
        raise AmplifierError(f"{path}: no flat_endpoints.json of an ODrive: {error}") from error


def _version(text: str) -> tuple[int, int, int]:
    major, minor, revision = (int(part) for part in text.split("."))
    return major, minor, revision


def _number(entries: dict[str, Any], endpoint: Endpoint) -> int:
    entry = entries[endpoint]
    if _TYPES.get(entry["type"]) is not LAYOUT[endpoint]:
        raise ValueError(f"{endpoint.value} is of type {entry['type']}")
    number = entry["id"]
    if not isinstance(number, int) or not 0 <= number < TIME_BASE_ID - 1:
        raise ValueError(f"{endpoint.value} has id {number!r}")
    return number
