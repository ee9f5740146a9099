"""Who may do what: Zenoh's configuration for router, daemon and people, with access control.

Roles: an *operator* reads everything and commands; an *observer* reads everything, and may `estop`
unless that is taken away. Everything that no rule allows is denied. The rules are enforced where a
link ends: by the router, and by a daemon that listens itself. Source of the keys: Zenoh's manual,
"Access control", "TLS authentication", "User-Password authentication".
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Literal

Auth = Literal["certificates", "passwords", "both"]
Role = Literal["operator", "observer"]
Json = dict[str, Any]

ROUTER: Final = "router"
DAEMON: Final = "daemon"
FILE: Final = "zenoh.json5"
CA_FILE: Final = "ca.pem"
CERTIFICATE_FILE: Final = "cert.pem"
KEY_FILE: Final = "key.pem"
PASSWORDS_FILE: Final = "passwords.txt"

_STREAMS: Final = ["hil/*/telemetry", "hil/*/status", "hil/*/event"]
_PRESENCE: Final = ["hil/*/alive", "hil/*/operator/*"]
_READABLE: Final = ["hil/*/schema", "hil/*/config", "hil/*/status"]
_ALL_MESSAGES: Final = [
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable",
    "liveliness_token", "declare_liveliness_subscriber", "liveliness_query",
]  # fmt: skip
_INTEREST: Final = ["declare_liveliness_subscriber", "liveliness_query"]

_RULES: Final[Mapping[str, tuple[str, list[str], list[str]]]] = {
    "streams reach people": ("egress", ["put"], _STREAMS),
    "answers reach people": ("egress", ["reply", "declare_queryable"], ["hil/**"]),
    "presence reaches people": ("egress", ["liveliness_token"], _PRESENCE),
    "people subscribe": ("ingress", ["declare_subscriber"], ["hil/**"]),
    "people look who is there": ("ingress", _INTEREST, ["hil/**"]),
    "people read": ("ingress", ["query"], _READABLE),
    "people stop": ("ingress", ["query"], ["hil/*/cmd/estop"]),
    "operators command": ("ingress", ["query"], ["hil/*/cmd/*"]),
    "operators show themselves": ("ingress", ["liveliness_token"], ["hil/*/operator/*"]),
    "daemons stream": ("ingress", ["put"], _STREAMS),
    "daemons answer": ("ingress", ["reply", "declare_queryable"], ["hil/**"]),
    "daemons are alive": ("ingress", ["liveliness_token"], ["hil/*/alive"]),
    "daemons look who is there": ("ingress", _INTEREST, ["hil/*/operator/*"]),
    "requests reach daemons": ("egress", ["query", "declare_subscriber", *_INTEREST], ["hil/**"]),
    "operators reach daemons": ("egress", ["liveliness_token"], ["hil/*/operator/*"]),
    "the router passes everything on": ("both", _ALL_MESSAGES, ["hil/**"]),
}
"""Flow as seen by the one who enforces it, messages, keys."""

_WATCHING: Final = (
    "streams reach people", "answers reach people", "presence reaches people",
    "people subscribe", "people look who is there", "people read",
)  # fmt: skip
_SERVING: Final = (
    "daemons stream", "daemons answer", "daemons are alive", "daemons look who is there",
    "requests reach daemons", "operators reach daemons",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Access:
    """Who takes part, and how they prove it.

    Attributes:
        people: Role of everyone by name.
        auth: certificates (mutual TLS), passwords (only the server shows a certificate), or both.
        observer_estop: Observers may take torque off.
        endpoint: Where people reach router or daemon.
    """

    people: Mapping[str, Role] = field(
        default_factory=lambda: {"operator": "operator", "observer": "observer"}
    )
    auth: Auth = "certificates"
    observer_estop: bool = True
    endpoint: str = "tls/localhost:7447"

    @property
    def with_passwords(self) -> bool:
        """A password is asked for."""
        return self.auth != "certificates"

    def names_of(self, role: Role) -> list[str]:
        """Names of those with this role."""
        return [name for name, given in self.people.items() if given == role]


def router_config(access: Access, password: str | None = None) -> Json:
    """Return the configuration of a router between one or several daemons and the people."""
    config: Json = {"mode": "router", "listen": {"endpoints": ["tls/[::]:7447"]}}
    return config | _guarded(access, ROUTER, password, {DAEMON: _SERVING})


def daemon_config(access: Access, password: str | None = None) -> Json:
    """Return the daemon's: for one that listens itself, and for one behind a router.

    Endpoints and mode are the daemon's own settings (`[zenoh]` in its TOML file).
    """
    return _guarded(access, DAEMON, password, {ROUTER: ("the router passes everything on",)})


def person_config(access: Access, name: str, password: str | None = None) -> Json:
    """Return the configuration of one operator's or observer's programs."""
    endpoints = {"mode": "client", "connect": {"endpoints": [access.endpoint]}}
    return endpoints | {"transport": _transport(access, name, password, is_server=False)}


def as_json5(config: Json, comment: str) -> str:
    """Return a Zenoh configuration as the text of a file."""
    return f"// {comment}\n{json.dumps(config, indent=2)}\n"


def _guarded(
    access: Access, name: str, password: str | None, others: Mapping[str, Sequence[str]]
) -> Json:
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "transport": _transport(access, name, password, is_server=True),
        "access_control": _access_control(access, others),
    }


def _transport(access: Access, name: str, password: str | None, *, is_server: bool) -> Json:
    has_certificate = is_server or access.auth != "passwords"
    tls: Json = {"root_ca_certificate": CA_FILE, "verify_name_on_connect": True}
    ends = (["listen"] if is_server else []) + (["connect"] if has_certificate else [])
    for end in ends:
        tls[f"{end}_certificate"] = CERTIFICATE_FILE
        tls[f"{end}_private_key"] = KEY_FILE
    # both ends need to know; zenoh 1.10 shows the client's certificate only if it does
    tls["enable_mtls"] = access.auth != "passwords"
    tls["close_link_on_expiration"] = True
    transport: Json = {"link": {"protocols": ["tls"], "tls": tls}}
    if access.with_passwords:
        usrpwd = {"user": name, "password": password or "change me"}
        if is_server:
            usrpwd["dictionary_file"] = PASSWORDS_FILE
        transport["auth"] = {"usrpwd": usrpwd}
    return transport


def _access_control(access: Access, others: Mapping[str, Sequence[str]]) -> Json:
    estop = ("people stop",) if access.observer_estop else ()
    granted: dict[str, tuple[list[str], Sequence[str]]] = {
        name: ([name], rules) for name, rules in others.items()
    }
    granted["operators"] = (
        access.names_of("operator"),
        (*_WATCHING, "operators command", "operators show themselves"),
    )
    granted["observers"] = (access.names_of("observer"), (*_WATCHING, *estop))
    policies, subjects, used = [], [], dict[str, None]()
    for names, rules in granted.values():
        if not names:
            continue
        subjects += [_subject(access, name) for name in names]
        policies.append({"subjects": names, "rules": list(rules)})
        used |= dict.fromkeys(rules)
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": [_rule(name) for name in used],
        "subjects": subjects,
        "policies": policies,
    }


def _subject(access: Access, name: str) -> Json:
    subject: Json = {"id": name}
    is_called = name == ROUTER  # it proves itself as TLS servers do, and sends no password
    if access.auth != "passwords" or is_called:
        subject["cert_common_names"] = [name]
    if access.with_passwords and not is_called:
        subject["usernames"] = [name]
    return subject


def _rule(name: str) -> Json:
    flow, messages, keys = _RULES[name]
    return {
        "id": name,
        "permission": "allow",
        "flows": ["ingress", "egress"] if flow == "both" else [flow],
        "messages": messages,
        "key_exprs": keys,
    }
