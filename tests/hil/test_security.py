"""Certificates, passwords and access control: real TLS over loopback, with and without a router."""

import json
import os
import stat
import subprocess
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh
from cryptography import x509

from hil.access import Access, as_json5
from hil.cli import main
from hil.client import Client, NoDaemonError
from hil.config import ConfigError, ZenohSettings, load_config
from hil.endpoints import is_local
from hil.keys import Authority, KeysError, comment_of, config_of, init_keys
from hil.session import SessionError, client_settings, find_open, make_config, open_session
from tests.hil.lab import free_port, wait_until

ROOT = Path(__file__).parents[2]
HOSTS = ("127.0.0.1", "localhost")
AUTHS = ("certificates", "passwords", "both")
SILENCE_S = 0.5
"""What is denied is never answered; this long is waited for it."""


@dataclass
class Network:
    """A stand-in for the daemon, behind a router or listening itself, and everyone's keys."""

    keys: Path
    endpoint: str
    sessions: list = field(default_factory=list)
    seen: list = field(default_factory=list)

    def start(self, *, with_router):
        listen = (self.endpoint,)
        if with_router:
            self.open("router", mode="router", listen=listen)
            daemon = self.open("daemon", mode="client", listen=(), connect=listen)
        else:
            daemon = self.open("daemon", mode="peer", listen=listen)
        self.held = [
            daemon.declare_queryable("hil/arm/cmd/*", self._answer),
            daemon.declare_queryable("hil/arm/schema", self._answer),
            daemon.declare_queryable("hil/arm/config", self._answer),
            daemon.liveliness().declare_token("hil/arm/alive"),
        ]
        self.status = daemon.declare_publisher("hil/arm/status")
        self.daemon = daemon
        return self

    def _answer(self, query):
        self.seen.append(str(query.key_expr).rpartition("/")[2])
        query.reply(query.key_expr, json.dumps({"ok": True}))

    def open(self, folder, **settings):
        settings["file"] = str(self.keys / folder / "zenoh.json5")
        session = open_session(ZenohSettings(**settings))
        self.sessions.append(session)
        return session

    def person(self, name):
        return self.open(name, mode="client", listen=(), connect=(self.endpoint,))

    def ask(self, session, key, payload="{}"):
        """Keys of the answers that come within a short time."""
        replies = session.get(key, payload=payload, timeout=SILENCE_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def ask_alive(self, session):
        """Keys of the daemons that the session sees."""
        replies = session.liveliness().get("hil/*/alive", timeout=SILENCE_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    def command(self, session, verb):
        """Whether the daemon got it. A right one is answered as soon as routes are known."""
        before = len(self.seen)
        answers = self.ask(session, f"hil/arm/cmd/{verb}")
        assert len(self.seen) - before == len(answers)
        return bool(answers)

    def hears_status(self, session):
        """Whether the session gets the daemon's status."""
        heard = threading.Event()
        subscriber = session.declare_subscriber("hil/arm/status", lambda _: heard.set())
        for _ in range(20):
            self.status.put("{}")
            if heard.wait(0.1):
                break
        subscriber.undeclare()
        return heard.is_set()

    def close(self):
        for session in reversed(self.sessions):
            session.close()


def access(auth="certificates", **more):
    people = {"alice": "operator", "bob": "observer"}
    return Access(people=people, auth=auth, **more)


@pytest.fixture
def network(tmp_path):
    """Build networks; close them at the end."""
    built = []

    def build(auth="certificates", *, with_router=True, **more):
        keys = tmp_path / f"keys{len(built)}"
        init_keys(keys, access(auth, **more), HOSTS)
        it = Network(keys, f"tls/127.0.0.1:{free_port()}")
        built.append(it)
        return it.start(with_router=with_router)

    yield build
    for it in built:
        it.close()


@pytest.fixture(autouse=True)
def _short_timeout(monkeypatch):
    """Who is not let in finds out by trying in vain."""
    monkeypatch.setattr("hil.session.CONNECT_TIMEOUT_MS", 1500)


every_way = pytest.mark.parametrize(
    ("auth", "with_router"),
    [("certificates", True), ("certificates", False), ("passwords", True), ("both", False)],
)
both_ways = pytest.mark.parametrize("with_router", [True, False], ids=["router", "direct"])


def edit(path, change):
    """Change a Zenoh configuration in place."""
    comment, _, text = path.read_text().partition("\n")
    config = json.loads(text)
    change(config)
    path.write_text(f"{comment}\n{json.dumps(config)}")


# --- roles --------------------------------------------------------------------------------------


@every_way
def test_operator__any_authentication__commands_and_reads(network, auth, with_router):
    it = network(auth, with_router=with_router)
    alice = it.person("alice")
    wait_until(lambda: it.command(alice, "enable"), what="the command")
    assert "enable" in it.seen
    assert it.ask(alice, "hil/arm/schema")
    assert it.ask(alice, "hil/arm/config")
    assert it.hears_status(alice)


@every_way
def test_observer__any_authentication__reads_and_stops_but_commands_nothing(
    network, auth, with_router
):
    it = network(auth, with_router=with_router)
    bob = it.person("bob")
    assert it.hears_status(bob)
    wait_until(lambda: it.ask(bob, "hil/arm/schema"), what="the schema")
    assert it.command(bob, "estop")
    for key in ("hil/arm/cmd/enable", "hil/arm/cmd/*", "hil/**", "hil/*/cmd/e$*", "**"):
        assert it.ask(bob, key) == []
    assert set(it.seen) == {"schema", "estop"}


@both_ways
def test_observer__estop_not_permitted__is_not_heard(network, with_router):
    it = network(with_router=with_router, observer_estop=False)
    bob = it.person("bob")
    wait_until(lambda: it.ask(bob, "hil/arm/schema"), what="the schema")
    assert not it.command(bob, "estop")
    assert "estop" not in it.seen


@both_ways
@pytest.mark.parametrize("name", ["alice", "bob"])
def test_person__poses_as_the_daemon__reaches_nobody(network, with_router, name):
    it = network(with_router=with_router)
    alice, impostor = it.person("alice"), it.person(name)
    heard, asked = [], []
    alice_hears = alice.declare_subscriber("hil/arm/*", lambda s: heard.append(bytes(s.payload)))
    poses = impostor.declare_queryable("hil/arm/cmd/enable", asked.append)
    token = impostor.liveliness().declare_token("hil/other/alive")
    assert it.hears_status(alice)
    heard.clear()
    impostor.put("hil/arm/status", "false")
    impostor.put("hil/arm/telemetry", "false")
    wait_until(lambda: it.command(alice, "enable"), what="the command")
    assert it.hears_status(alice)  # what was sent before has come by now
    assert b"false" not in heard
    assert asked == []
    assert it.ask_alive(alice) == ["hil/arm/alive"]
    del alice_hears, poses, token


@both_ways
def test_operator_token__operator_and_observer__only_the_operators_is_seen(network, with_router):
    it = network(with_router=with_router)
    alice, bob = it.person("alice"), it.person("bob")
    held = [
        alice.liveliness().declare_token("hil/arm/operator/alice"),
        bob.liveliness().declare_token("hil/arm/operator/bob"),
    ]

    def present():
        replies = it.daemon.liveliness().get("hil/arm/operator/*", timeout=SILENCE_S)
        return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]

    assert wait_until(present, what="the token") == ["hil/arm/operator/alice"]
    assert it.ask_alive(bob) == ["hil/arm/alive"]
    del held


# --- who does not get in ------------------------------------------------------------------------


@both_ways
def test_client__without_certificate__gets_no_session(network, with_router):
    it = network(with_router=with_router)
    edit(it.keys / "alice" / "zenoh.json5", without_certificate)
    with pytest.raises(SessionError, match="certificate or password are not accepted"):
        it.person("alice")


def without_certificate(config):
    tls = config["transport"]["link"]["tls"]
    for key in ("connect_certificate", "connect_private_key", "enable_mtls"):
        del tls[key]


@both_ways
def test_client__certificate_of_another_authority__gets_no_session(network, with_router):
    it = network(with_router=with_router)
    certificate, key = Authority.create().issue("alice", (), 1)
    (it.keys / "alice" / "cert.pem").write_bytes(certificate)
    (it.keys / "alice" / "key.pem").write_bytes(key)
    with pytest.raises(SessionError, match="not accepted"):
        it.person("alice")


def test_client__server_of_another_authority__does_not_connect(network):
    it = network()
    (it.keys / "alice" / "ca.pem").write_bytes(Authority.create().certificate)
    with pytest.raises(SessionError, match="no connection"):
        it.person("alice")


def test_client__without_tls__gets_no_session(network):
    it = network()
    with pytest.raises(SessionError):
        open_session(client_settings([it.endpoint.replace("tls/", "tcp/")]))


@both_ways
def test_stranger__certificate_of_the_authority_but_no_role__may_nothing(
    network, tmp_path, with_router
):
    it = network(with_router=with_router)
    others = tmp_path / "others"
    ca = x509.load_pem_x509_certificate((it.keys / "ca" / "cert.pem").read_bytes())
    key = load_key(it.keys / "ca" / "key.pem")
    certificate, own_key = Authority(ca, key).issue("mallory", (), 1)
    others.mkdir()
    (others / "cert.pem").write_bytes(certificate)
    (others / "key.pem").write_bytes(own_key)
    (others / "ca.pem").write_bytes((it.keys / "ca" / "cert.pem").read_bytes())
    (others / "zenoh.json5").write_text(
        as_json5(config_of("mallory", access()), "one without a role")
    )
    alice = it.person("alice")
    wait_until(lambda: it.command(alice, "enable"), what="the command")
    file = str(others / "zenoh.json5")
    with open_session(client_settings([file, it.endpoint])) as mallory:
        it.seen.clear()
        assert not it.command(mallory, "estop")
        assert it.ask(mallory, "hil/arm/schema") == []
        assert not it.hears_status(mallory)
    assert it.seen == []


def load_key(path):
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    return load_pem_private_key(path.read_bytes(), None)


@pytest.mark.parametrize(("auth", "with_router"), [("passwords", True), ("both", False)])
def test_client__wrong_password__gets_no_session(network, auth, with_router):
    it = network(auth, with_router=with_router)

    def spoil(config):
        config["transport"]["auth"]["usrpwd"]["password"] = "guessed"

    edit(it.keys / "alice" / "zenoh.json5", spoil)
    with pytest.raises(SessionError, match="not accepted"):
        it.person("alice")


@pytest.mark.parametrize("auth", ["passwords", "both"])
def test_client__no_password__gets_no_session(network, auth):
    it = network(auth)
    edit(it.keys / "alice" / "zenoh.json5", lambda config: config["transport"].pop("auth"))
    with pytest.raises(SessionError, match="not accepted"):
        it.person("alice")


@both_ways
def test_observer__with_the_operators_name_in_the_password__stays_observer(network, with_router):
    """Certificate and name must belong together."""
    it = network("both", with_router=with_router)
    alices = json.loads((it.keys / "alice" / "zenoh.json5").read_text().partition("\n")[2])
    edit(
        it.keys / "bob" / "zenoh.json5",
        lambda config: config["transport"].update(auth=alices["transport"]["auth"]),
    )
    alice = it.person("alice")
    wait_until(lambda: it.command(alice, "enable"), what="the command")
    mixed = it.person("bob")
    it.seen.clear()
    assert not it.command(mixed, "enable")
    assert it.seen == []


# --- the library and the command line -----------------------------------------------------------


def test_client__configuration_file_as_endpoint__commands(network):
    it = network()
    file = it.keys / "alice" / "zenoh.json5"
    edit(file, lambda config: config["connect"].update(endpoints=[it.endpoint]))
    with Client("arm", [str(file)]) as client:
        wait_until(lambda: answers(client), what="the schema")


def answers(client):
    try:
        return client.schema()
    except NoDaemonError:
        return None


def test_keys_init__twice__refuses_and_touches_nothing(tmp_path, capsys):
    assert main(["keys", "init", str(tmp_path / "keys"), "--host", "arm.example"]) == 0
    before = {p: p.read_bytes() for p in (tmp_path / "keys").rglob("*") if p.is_file()}
    assert main(["keys", "init", str(tmp_path / "keys")]) == 1
    assert "never overwritten" in capsys.readouterr().err
    assert before == {p: p.read_bytes() for p in (tmp_path / "keys").rglob("*") if p.is_file()}


@pytest.mark.parametrize("auth", AUTHS)
def test_keys_init__any_umask__files_are_private(tmp_path, auth):
    before = os.umask(0)
    try:
        init_keys(tmp_path / "keys", access(auth), HOSTS)
    finally:
        os.umask(before)
    for path in [tmp_path / "keys", *(tmp_path / "keys").rglob("*")]:
        assert stat.S_IMODE(path.stat().st_mode) == (0o700 if path.is_dir() else 0o600), path


def test_keys_init__person__has_no_servers_certificate_and_own_name(tmp_path):
    init_keys(tmp_path / "keys", access(), HOSTS)
    verify = ["openssl", "verify", "-CAfile", str(tmp_path / "keys" / "ca" / "cert.pem")]
    for name, purpose, is_right in (
        ("alice", "sslclient", True),
        ("alice", "sslserver", False),
        ("router", "sslserver", True),
        ("daemon", "sslclient", True),
    ):
        certificate = tmp_path / "keys" / name / "cert.pem"
        command = [*verify, "-purpose", purpose, certificate]
        done = subprocess.run(command, capture_output=True, check=False)
        assert (done.returncode == 0) is is_right, (name, purpose, done.stderr)


@pytest.mark.parametrize("name", ["router", "ca", "../x", "", "a b", "é"])
def test_keys_init__name_that_cannot_be__refuses_before_writing(tmp_path, name):
    with pytest.raises(KeysError, match="letters, digits"):
        init_keys(tmp_path / "keys", Access(people={name: "operator"}), HOSTS)
    assert not (tmp_path / "keys").exists()


@pytest.mark.parametrize("name", ["router", "daemon", "operator", "observer"])
def test_shipped_configuration__is_what_keys_init_writes(name):
    shipped = (ROOT / "deploy" / "zenoh" / f"{name}.json5").read_text()
    assert shipped == as_json5(config_of(name, Access()), comment_of(name, Access()))
    zenoh.Config.from_json5(shipped)


# --- open or not --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("endpoint", "expected"),
    [
        ("tcp/127.0.0.1:7447", True),
        ("tcp/127.8.8.8:1", True),
        ("tcp/[::1]:7447", True),
        ("tcp/localhost:7447", True),
        ("unixsock-stream//run/x", True),
        ("tcp/0.0.0.0:7447", False),
        ("tcp/[::]:7447", False),
        ("tls/192.168.1.5:7447#iface=lo", False),
        ("tcp/localhost.example.org:7447", False),
        ("udp/224.0.0.1:7447", False),
        ("nonsense", False),
    ],
)
def test_is_local__endpoint__says_whether_others_reach_it(endpoint, expected):
    assert is_local(endpoint) is expected


@pytest.mark.parametrize("over", [{"listen": ["tcp/0.0.0.0:7447"]}, {"multicast_scouting": True}])
def test_config__open_without_saying_so__refused(over):
    with pytest.raises(ConfigError, match=r"zenoh.allow_open = true"):
        load_config(None, {"zenoh": over})
    assert load_config(None, {"zenoh": over | {"allow_open": True}}).zenoh.allow_open


def open_for(keys, change=lambda config: None, **settings):
    """What is open of a daemon with these settings and the changed file."""
    file = keys / "daemon" / "zenoh.json5"
    edit(file, change)
    return find_open(make_config(ZenohSettings(file=str(file), **settings)))


@pytest.mark.parametrize("auth", AUTHS)
def test_find_open__files_of_keys_init__nothing(tmp_path, auth):
    init_keys(tmp_path / "keys", access(auth), HOSTS)
    assert open_for(tmp_path / "keys", listen=("tls/0.0.0.0:7447",)) is None


@pytest.mark.parametrize(
    ("listen", "is_open"),
    [
        ("tcp/0.0.0.0:7447", True),
        ("tls/0.0.0.0:7447#enable_mtls=false", True),
        ("tls/0.0.0.0:7447", False),
        ("tcp/127.0.0.1:7447", False),
    ],
)
def test_find_open__with_mutual_tls__tells_what_it_does_not_cover(tmp_path, listen, is_open):
    init_keys(tmp_path / "keys", access(), HOSTS)
    assert open_for(tmp_path / "keys", listen=(listen,)) == (listen if is_open else None)


def test_open_session__file_without_authentication__refused(tmp_path):
    file = tmp_path / "zenoh.json5"
    file.write_text("{}")
    settings = ZenohSettings(listen=(f"tcp/0.0.0.0:{free_port()}",), file=str(file))
    with pytest.raises(SessionError, match="allow_open"):
        open_session(settings)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"{", "Zenoh configuration"),
        (b"\xff\xfe", "not a text"),
        (b'{"nonsense": 1}', "Zenoh configuration"),
        (b'{transport: {link: {tls: {root_ca_certificate: "gone.pem"}}}}', "no file"),
    ],
)
def test_make_config__file_that_cannot_be_used__says_why_in_one_line(tmp_path, content, reason):
    file = tmp_path / "zenoh.json5"
    file.write_bytes(content)
    with pytest.raises(SessionError, match=reason) as caught:
        make_config(ZenohSettings(file=str(file)))
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


def test_daemon__real_one_with_tls__obeys_the_operator_alone(lab, tmp_path):
    init_keys(tmp_path / "keys", access(), HOSTS)
    endpoint = f"tls/127.0.0.1:{lab.port}"
    lab.emulate()
    options, _ = lab.run_options()
    settings = f'zenoh={{listen=["{endpoint}"], file="{tmp_path}/keys/daemon/zenoh.json5"}}'
    daemon = lab.start(*options, "--set", settings)
    daemon.wait_for_line()
    files = {name: str(tmp_path / "keys" / name / "zenoh.json5") for name in ("alice", "bob")}
    with Client(lab.arm, [files["alice"], endpoint]) as alice:
        assert alice.command("enable").ok
    with Client(lab.arm, [files["bob"], endpoint]) as bob:
        assert bob.config()["zenoh"]["file"]
        assert bob.command("estop").ok
    with pytest.raises(SessionError):
        Client(lab.arm, [lab.endpoint])
    assert daemon.end() == 0


def test_hil_keys__library_not_there__names_the_remedy(tmp_path):
    block = "import sys; sys.modules['cryptography'] = None; from hil.cli import main; "
    code = f"{block}sys.exit(main(['keys', 'init', {str(tmp_path / 'k')!r}]))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=False
    )
    assert done.returncode == 1
    assert "pip install 'hil[tls]'" in done.stderr
