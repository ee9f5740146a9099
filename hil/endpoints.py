"""Zenoh endpoints (`PROTOCOL/ADDRESS?METADATA#CONFIG`): who can reach them."""

import ipaddress
from collections.abc import Iterable
from typing import Final

_OF_THIS_HOST: Final = frozenset({"unixsock-stream", "unixpipe", "serial"})
AUTHENTICATING: Final = frozenset({"tls", "quic"})
"""Protocols that can ask for a client's certificate."""


def protocol_of(endpoint: str) -> str:
    """Return an endpoint's protocol."""
    return endpoint.partition("/")[0].lower()


def is_local(endpoint: str) -> bool:
    """Only programs on this host can reach it."""
    if protocol_of(endpoint) in _OF_THIS_HOST:
        return True
    address = endpoint.partition("/")[2].partition("#")[0].partition("?")[0]
    host = address.rpartition(":")[0].strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def reachable(endpoints: Iterable[str]) -> list[str]:
    """Return those that other hosts can reach."""
    return [endpoint for endpoint in endpoints if not is_local(endpoint)]
