"""Checks of host, configuration, bus and Zenoh, each with a verdict and a remedy."""

import errno
import json
import shutil
import socket
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

from drivers.bus import open_bus, split_address
from drivers.errors import DriverError
from hil.budget import REMEDY, WARNING_SHARE, bus_budget
from hil.config import Config
from hil.finding import Finding, Level
from hil.host_checks import HOST_CHECKS, read
from hil.session import SessionError, describe_access, find_open, make_config
from hil.watchdogs import check_watchdogs

_CONNECT_TIMEOUT_S = 1.0
_NO_ACCESS = "no authentication"
"""What `describe_access` says of a daemon that only this host can reach."""
_PROGRAM_TIMEOUT_S = 5.0
_GRAVITY = {"pass": 0, "warn": 1, "fail": 2}


def examine(config: Config) -> list[Finding]:
    """Run every check. Nothing is sent to an amplifier."""
    checks: tuple[Callable[[Config], Finding], ...] = (
        *HOST_CHECKS,
        _bus,
        _can_interface,
        check_bus_load,
        check_watchdogs,
        _zenoh,
        _routers,
    )
    return [check(config) for check in checks]


def _bus(config: Config) -> Finding:
    for address in config.bus.addresses:
        try:
            with open_bus(address):
                pass
        except DriverError as error:
            return Finding("bus", "fail", str(error), "see the message")
    return Finding("bus", "pass", f"{', '.join(config.bus.addresses)} can be joined")


def _can_interface(config: Config) -> Finding:
    parts = [split_address(address) for address in config.bus.addresses]
    interfaces = [interface for scheme, interface in parts if scheme == "socketcan"]
    if not interfaces:
        return Finding("can interface", "pass", "the bus is none of the kernel's")
    queues = [read(Path(f"/sys/class/net/{name}/tx_queue_len")) for name in interfaces]
    findings = [
        judge_can(config, name, queue, _link_details(name))
        for name, queue in zip(interfaces, queues, strict=True)
    ]
    return max(findings, key=lambda finding: _GRAVITY[finding.level])


def judge_can(config: Config, interface: str, queue: str, details: dict[str, Any]) -> Finding:
    """Judge bit rate and send queue of one of the kernel's CAN interfaces.

    Args:
        config: The bit rate wanted, and how many joints there are.
        interface: Its name.
        queue: Its send queue in frames, as the kernel says it.
        details: Its entry of `ip -details -json link show`; empty if that is not to be had.
    """
    name = "can interface"
    data = details.get("linkinfo", {}).get("info_data", {})
    bit_rate, state = data.get("bittiming", {}).get("bitrate"), data.get("state", "")
    if bit_rate is not None and bit_rate != config.bus.bit_rate:
        wanted = config.bus.bit_rate
        remedy = (
            f"ip link set {interface} down; ip link set {interface} up type can bitrate {wanted}, "
            "or set bus.bit_rate"
        )
        found = f"{interface} runs at {bit_rate} bit/s, bus.bit_rate is {wanted}"
        return Finding(name, "fail", found, remedy)
    if state in ("BUS-OFF", "STOPPED"):
        remedy = f"check wiring and terminators, then ip link set {interface} type can restart"
        return Finding(name, "fail", f"{interface} is in state {state}", remedy)
    rate = f"{bit_rate} bit/s" if bit_rate is not None else "no bit rate (virtual, or no `ip`)"
    found = f"{interface}, {rate}, send queue of {queue or '?'} frames"
    if queue.isdigit() and int(queue) < 4 * config.joints:
        return Finding(name, "warn", found, f"ip link set {interface} txqueuelen 128")
    if state in ("ERROR-WARNING", "ERROR-PASSIVE"):
        return Finding(name, "warn", f"{found}, {state}", "check wiring and terminators")
    return Finding(name, "pass", found)


def _link_details(interface: str) -> dict[str, Any]:
    program = shutil.which("ip", path="/usr/sbin:/sbin:/usr/bin:/bin")
    if program is None:
        return {}
    try:
        done = subprocess.run(  # noqa: S603 - iproute2; the name has been opened as an interface
            [program, "-details", "-json", "link", "show", "dev", interface],
            capture_output=True,
            check=True,
            timeout=_PROGRAM_TIMEOUT_S,
        )
        (details,) = json.loads(done.stdout)
    except (OSError, subprocess.SubprocessError, ValueError):
        return {}
    return details if isinstance(details, dict) else {}


def check_bus_load(config: Config) -> Finding:
    """Judge the bus budget alone (`hil.budget`)."""
    budget = bus_budget(config)
    where = " on the fullest bus" if config.bus.more else ""
    found = f"a cycle needs {100 * budget.share:.1f} % of the period at worst{where}"
    if not budget.is_fitting:
        return Finding("bus load", "fail", f"{found}: {budget.arithmetic()}", REMEDY)
    if budget.share > WARNING_SHARE:
        return Finding("bus load", "warn", found, REMEDY)
    return Finding("bus load", "pass", found)


def _zenoh(config: Config) -> Finding:
    """Judge whether the daemon can listen, and who may then command it."""
    settings = config.zenoh
    try:
        found_open, access = find_open(make_config(settings)), describe_access(settings)
    except SessionError as error:
        return Finding("zenoh", "fail", str(error), "correct zenoh.file or the endpoints")
    for endpoint in settings.listen:
        place = _tcp_place(endpoint)
        if place is None:
            continue
        host, port = place
        family = socket.AF_INET6 if host.startswith("[") else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((host.strip("[]"), port))
            except OSError as error:
                level: Level = "warn" if error.errno == errno.EADDRINUSE else "fail"
                return Finding("zenoh", level, f"{endpoint}: {error.strerror}", "set zenoh.listen")
    if found_open is not None:
        level = "warn" if settings.allow_open else "fail"
        remedy = "anyone who reaches it can command: use a zenoh.file made by `hil keys init`"
        return Finding("zenoh", level, f"open to the network: {found_open}", remedy)
    where = ", ".join(settings.listen) or "listens nowhere"
    return Finding("zenoh", "pass", where if access == _NO_ACCESS else f"{where}; {access}")


def _routers(config: Config) -> Finding:
    """Judge whether the routers and peers to join can be reached."""
    reached, name = [], "zenoh routers"
    level: Level = "fail" if config.zenoh.mode == "client" else "warn"
    for endpoint in config.zenoh.connect:
        place = _tcp_place(endpoint)
        if place is None:
            continue
        host, port = place
        try:
            with socket.create_connection((host.strip("[]"), port), _CONNECT_TIMEOUT_S):
                reached.append(endpoint)
        except OSError as error:
            reason = error.strerror or str(error)
            return Finding(name, level, f"{endpoint}: {reason}", "start it, or set zenoh.connect")
    if config.zenoh.mode == "client" and not config.zenoh.connect:
        found = 'zenoh.mode is "client", zenoh.connect is empty'
        return Finding(name, "fail", found, "name a router in zenoh.connect")
    return Finding(name, "pass", f"reached: {', '.join(reached)}" if reached else "none to reach")


def _tcp_place(endpoint: str) -> tuple[str, int] | None:
    """Return host and port of a TCP or TLS endpoint, None of another one."""
    protocol, _, address = endpoint.partition("/")
    host, _, port = address.split("?")[0].split("#")[0].rpartition(":")
    is_known = protocol in ("tcp", "tls") and port.isdigit()
    return (host, int(port)) if is_known else None
