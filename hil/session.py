"""Zenoh sessions, opened from settings. Use them in `with` blocks: an open one blocks exit."""

import json
from collections.abc import Sequence

import zenoh

from hil.config import ZenohSettings
from hil.errors import HilError

CONNECT_TIMEOUT_MS = 3000
RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""How often a lost connection is tried anew: a restarted gateway is back within a second or two."""


class SessionError(HilError):
    """A Zenoh session could not be opened."""


def open_session(settings: ZenohSettings) -> zenoh.Session:
    """Open a session that listens and connects as configured.

    Raises:
        SessionError: If an endpoint is in use, malformed or cannot be reached; one line.
    """
    zenoh_config = zenoh.Config()
    values: dict[str, object] = {
        "mode": settings.mode,
        "listen/endpoints": list(settings.listen),
        "connect/endpoints": list(settings.connect),
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        "connect/exit_on_failure": True,
        "connect/retry": RETRY,
        "scouting/multicast/enabled": settings.multicast_scouting,
    }
    try:
        for key, value in values.items():
            zenoh_config.insert_json5(key, json.dumps(value))
        return zenoh.open(zenoh_config)
    except zenoh.ZError as error:
        raise SessionError(_explain(settings, str(error))) from error


def _explain(settings: ZenohSettings, message: str) -> str:
    if "Unable to connect" in message:
        endpoints = ", ".join(settings.connect)
        return f"nobody answers at {endpoints}; is `hil run` (or a Zenoh router) up there?"
    endpoints = ", ".join([*settings.listen, *settings.connect])
    if "in use" in message:
        return f"Zenoh cannot listen at {endpoints}: address in use; set zenoh.listen to another"
    message, _, _ = message.partition(" at /")  # the place in Zenoh's source
    reason = message.rpartition('msg: "')[2].rstrip(" [")
    return f"Zenoh session ({endpoints}): {reason}"


def client_settings(endpoints: Sequence[str]) -> ZenohSettings:
    """Settings of a client that connects to a daemon (or router) at `endpoints`."""
    return ZenohSettings(mode="client", listen=(), connect=tuple(endpoints))
