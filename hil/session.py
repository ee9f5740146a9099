"""Zenoh sessions, opened from settings. Use them in `with` blocks: an open one blocks exit."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import zenoh

from hil.config import ZenohSettings
from hil.endpoints import AUTHENTICATING, protocol_of, reachable
from hil.errors import HilError

CONNECT_TIMEOUT_MS = 3000
RETRY = {"period_init_ms": 100, "period_max_ms": 1000, "period_increase_factor": 1.5}
"""How often a lost connection is tried anew: a restarted gateway is back within a second or two."""
LINK_LEASE_MS: Final = 5000
"""A client that shows no life for so long is gone, and its authority with it."""
QUEUE_BATCHES: Final = 16
"""Of 64 kB each: what a subscriber may be behind, beyond the system's own buffers."""
WAIT_BEFORE_DROP_US: Final = 5000
FILE_SUFFIX: Final = ".json5"
FILE_KEYS: Final = (
    *(
        f"transport/link/tls/{name}"
        for name in ("root_ca_certificate", "listen_certificate", "listen_private_key",
                     "connect_certificate", "connect_private_key")
    ),
    "transport/auth/usrpwd/dictionary_file",
)  # fmt: skip
"""Settings that are paths."""


class SessionError(HilError):
    """A Zenoh session could not be opened."""


def open_session(settings: ZenohSettings) -> zenoh.Session:
    """Open a session that listens and connects as configured.

    Raises:
        SessionError: If an endpoint is in use, malformed, open to all or cannot be reached, or
            `settings.file` cannot be used; one line.
    """
    zenoh_config = make_config(settings)
    if not settings.allow_open and (found := find_open(zenoh_config)):
        raise SessionError(
            f"{found} reaches beyond this host and {settings.file or 'nothing'} asks nobody who "
            "they are: use a file made by `hil keys init`, or set zenoh.allow_open = true"
        )
    try:
        return zenoh.open(zenoh_config)
    except zenoh.ZError as error:
        raise SessionError(_explain(settings, zenoh_config, str(error))) from error


def make_config(settings: ZenohSettings) -> zenoh.Config:
    """Return Zenoh's configuration: that of the file, and on it the settings.

    Raises:
        SessionError: If the file cannot be read or a value is not accepted; one line.
    """
    zenoh_config = _read(settings.file) if settings.file else zenoh.Config()
    values: dict[str, object] = {
        "mode": settings.mode,
        "listen/endpoints": list(settings.listen),
        "connect/timeout_ms": CONNECT_TIMEOUT_MS,
        "connect/exit_on_failure": True,
        "connect/retry": RETRY,
        "scouting/multicast/enabled": settings.multicast_scouting,
        "transport/link/tx/queue/size/data": QUEUE_BATCHES,
        "transport/link/tx/queue/congestion_control/drop/wait_before_drop": WAIT_BEFORE_DROP_US,
    }
    if settings.mode == "client":
        values["transport/link/tx/lease"] = LINK_LEASE_MS
    if settings.connect or not settings.file:
        values["connect/endpoints"] = list(settings.connect)
    try:
        for key, value in values.items():
            zenoh_config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise SessionError(_explain(settings, zenoh_config, str(error))) from error
    return zenoh_config


def find_open(zenoh_config: zenoh.Config) -> str | None:
    """Return what lets unknown programs on other hosts in, or None.

    They are known by their certificates (mutual TLS) or by name and password.
    """
    if _get(zenoh_config, "transport/auth/usrpwd/dictionary_file"):
        return None
    has_mtls = bool(_get(zenoh_config, "transport/link/tls/enable_mtls"))
    for endpoint in reachable(_endpoints(zenoh_config, "listen")):
        asks = has_mtls and "enable_mtls" not in endpoint.partition("#")[2]
        if not (asks and protocol_of(endpoint) in AUTHENTICATING):
            return endpoint
    is_scouting = bool(_get(zenoh_config, "scouting/multicast/enabled"))
    return "multicast scouting" if is_scouting and not has_mtls else None


def describe_access(settings: ZenohSettings) -> str:
    """Say in words how those who connect are known.

    Raises:
        SessionError: As for `make_config`.
    """
    zenoh_config = make_config(settings)
    means = {
        "mutual TLS": _get(zenoh_config, "transport/link/tls/enable_mtls"),
        "passwords": _get(zenoh_config, "transport/auth/usrpwd/dictionary_file"),
        "access control": _get(zenoh_config, "access_control/enabled"),
    }
    return ", ".join(name for name, given in means.items() if given) or "no authentication"


def _read(path: str) -> zenoh.Config:
    """Read a Zenoh configuration; paths in it are relative to its folder."""
    try:
        zenoh_config = zenoh.Config.from_json5(Path(path).read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a text"
        raise SessionError(f"Zenoh configuration {path}: {reason}") from error
    except zenoh.ZError as error:
        raise SessionError(f"Zenoh configuration {path}: {_reason(str(error))}") from error
    folder = Path(path).resolve().parent
    for key in FILE_KEYS:
        if name := _get(zenoh_config, key):
            if not (folder / name).is_file():
                raise SessionError(f"Zenoh configuration {path}: {key}: no file {folder / name}")
            zenoh_config.insert_json5(key, json.dumps(str(folder / name)))
    return zenoh_config


def _get(zenoh_config: zenoh.Config, key: str) -> Any:  # noqa: ANN401 - JSON
    return json.loads(zenoh_config.get_json(key))


def _endpoints(zenoh_config: zenoh.Config, side: str) -> list[str]:
    found = _get(zenoh_config, f"{side}/endpoints") or []
    if isinstance(found, dict):  # one list for every mode
        found = found.get(_get(zenoh_config, "mode")) or []
    return [str(endpoint) for endpoint in found]


def _explain(settings: ZenohSettings, zenoh_config: zenoh.Config, message: str) -> str:
    connect = ", ".join(_endpoints(zenoh_config, "connect"))
    if "Unable to connect" in message:
        if settings.file:
            return (
                f"no connection to {connect} as {settings.file} says: nobody answers there, or "
                "certificate or password are not accepted"
            )
        return f"nobody answers at {connect}; is `hil run` (or a Zenoh router) up there?"
    endpoints = ", ".join([*settings.listen, *settings.connect])
    if "in use" in message:
        return f"Zenoh cannot listen at {endpoints}: address in use; set zenoh.listen to another"
    return f"Zenoh session ({endpoints or connect}): {_reason(message)}"


def _reason(message: str) -> str:
    message, _, _ = message.partition(" at /")  # the place in Zenoh's source
    return " ".join(message.rpartition('msg: "')[2].rstrip(" [").split())


def client_settings(endpoints: Sequence[str]) -> ZenohSettings:
    """Settings of a client that connects to a daemon (or router).

    Args:
        endpoints: Zenoh endpoints; one that ends in `.json5` is a Zenoh configuration file
            instead, and says by itself where to connect to unless endpoints are given, too.
    """
    files = [endpoint for endpoint in endpoints if endpoint.endswith(FILE_SUFFIX)]
    connect = tuple(endpoint for endpoint in endpoints if endpoint not in files)
    file = files[-1] if files else None
    return ZenohSettings(mode="client", listen=(), connect=connect, file=file)
