"""`hil keys`: certificates and Zenoh configurations of router, daemon, operators and observers."""

import argparse
from pathlib import Path

from hil.access import Access, Role
from hil.errors import HilError

PORT = 7447


class MissingLibraryError(HilError):
    """The library that makes keys is not installed."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the verb's options."""
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    init = commands.add_parser("init", help="make an authority and everyone's keys")
    init.add_argument("directory", metavar="DIR", help="new folder; one folder each is made in it")
    init.add_argument(
        "--host",
        action="append",
        metavar="NAME",
        help="name or address by which router or daemon is reached, the first one by people "
        "(default: localhost and this host's name)",
    )
    for role in ("operator", "observer"):
        init.add_argument(
            f"--{role}", action="append", metavar="NAME", help=f"an {role} (default: {role})"
        )
    init.add_argument(
        "--auth",
        choices=("certificates", "passwords", "both"),
        default="certificates",
        help="how people prove who they are (default: %(default)s, which is mutual TLS)",
    )
    init.add_argument(
        "--no-observer-estop", action="store_true", help="observers may not take torque off"
    )
    init.add_argument("--days", type=int, default=825, help="validity (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Make the keys and say where each folder belongs."""
    try:
        from hil.keys import KeysError, default_hosts, init_keys
    except ModuleNotFoundError as error:
        raise MissingLibraryError(
            f"{error.name} is not installed: pip install 'hil[tls]'"
        ) from error
    if not 1 <= options.days <= 3650:
        raise KeysError(f"--days {options.days}: 1 to 3650 are possible")
    hosts = list(dict.fromkeys([*(options.host or []), *default_hosts()]))
    host = f"[{hosts[0]}]" if ":" in hosts[0] else hosts[0]
    access = Access(
        people=_people(options),
        auth=options.auth,
        observer_estop=not options.no_observer_estop,
        endpoint=f"tls/{host}:{PORT}",
    )
    made = init_keys(Path(options.directory), access, hosts, options.days)
    for folder in made:
        print(folder)
    print(
        f"keep {made[0]} off line; copy each other folder to where it belongs (mode 0700); "
        'daemon: zenoh.file = "DIR/daemon/zenoh.json5"; people: --connect DIR/NAME/zenoh.json5'
    )
    return 0


def _people(options: argparse.Namespace) -> dict[str, Role]:
    people: dict[str, Role] = {}
    given: tuple[tuple[Role, list[str] | None], ...] = (
        ("operator", options.operator),
        ("observer", options.observer),
    )
    for role, names in given:
        for name in names or [role]:
            if people.setdefault(name, role) != role:
                raise HilError(f"{name!r} cannot be both operator and observer")
    return people
