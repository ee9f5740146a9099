"""Keys and certificates of everyone who takes part, in one folder each.

`DIR/ca` (keep it off line), `DIR/router`, `DIR/daemon` and one folder per person; each holds its
certificate, its private key, the authority's certificate and `zenoh.json5`, and is copied as a
whole to where it belongs. Files have mode 0600, folders 0700.
"""

import ipaddress
import os
import re
import secrets
import socket
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from hil.access import (
    CA_FILE,
    CERTIFICATE_FILE,
    DAEMON,
    FILE,
    KEY_FILE,
    PASSWORDS_FILE,
    ROUTER,
    Access,
    Json,
    as_json5,
    daemon_config,
    person_config,
    router_config,
)
from hil.errors import HilError

CA: Final = "ca"
CA_DAYS: Final = 3650
DAYS: Final = 825
_NAME: Final = re.compile(r"[A-Za-z0-9_-]{1,32}")
_BEFORE: Final = timedelta(minutes=5)
"""Certificates are valid from a little earlier on: clocks differ."""


class KeysError(HilError):
    """Keys could not be made; what was there has not been touched."""


def default_hosts() -> list[str]:
    """Names and addresses by which this host is reached from itself."""
    return ["localhost", "127.0.0.1", "::1", socket.gethostname()]


def init_keys(
    directory: Path, access: Access, hosts: Sequence[str], days: int = DAYS
) -> list[Path]:
    """Make an authority and the folders of router, daemon and everyone in `access`.

    Args:
        directory: Must not exist, or be empty.
        access: Who takes part.
        hosts: Names and addresses under which router and daemon are reached.
        days: Validity of all certificates but the authority's.

    Returns:
        The folders made.

    Raises:
        KeysError: If the folder is in use or a name cannot be used; nothing has been written.
    """
    _check(directory, access)
    made = Authority.create()
    servers, names = (ROUTER, DAEMON), (ROUTER, DAEMON, *access.people)
    passwords = {name: secrets.token_urlsafe(24) for name in names if access.with_passwords}
    _make_folder(directory)
    _write_folder(directory / CA, {CERTIFICATE_FILE: made.certificate, KEY_FILE: made.key})
    for name in names:
        files = {CA_FILE: made.certificate}
        is_server = name in servers
        if is_server or access.auth != "passwords":
            certificate, key = made.issue(name, hosts if is_server else (), days)
            files |= {CERTIFICATE_FILE: certificate, KEY_FILE: key}
        if is_server and passwords:
            files[PASSWORDS_FILE] = "".join(f"{n}:{p}\n" for n, p in passwords.items()).encode()
        config = config_of(name, access, passwords.get(name))
        files[FILE] = as_json5(config, comment_of(name, access)).encode()
        _write_folder(directory / name, files)
    return [directory / name for name in (CA, *names)]


def config_of(name: str, access: Access, password: str | None = None) -> Json:
    """Return one participant's Zenoh configuration."""
    if name == ROUTER:
        return router_config(access, password)
    if name == DAEMON:
        return daemon_config(access, password)
    return person_config(access, name, password)


def comment_of(name: str, access: Access) -> str:
    """Return the first line of one participant's file."""
    role = access.people.get(name, name)
    whose = name if name == role else f"{role} {name}"
    return f"Zenoh configuration of the {whose}; paths are relative to this file's folder."


class Authority:
    """A certificate authority: its certificate and key, and those it issues, as PEM."""

    def __init__(self, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
        self._certificate = certificate
        self._key = key
        self.certificate = certificate.public_bytes(serialization.Encoding.PEM)
        self.key = _pem(key)

    @classmethod
    def create(cls) -> "Authority":
        """Make a new one."""
        key = ec.generate_private_key(ec.SECP256R1())
        name = _name("hil authority")
        builder = _builder(name, name, key, CA_DAYS).add_extension(
            x509.BasicConstraints(ca=True, path_length=0), critical=True
        )
        usage = _usage(is_authority=True)
        public = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
        builder = builder.add_extension(usage, critical=True).add_extension(public, critical=False)
        return cls(builder.sign(key, hashes.SHA256()), key)

    def issue(self, name: str, hosts: Sequence[str], days: int) -> tuple[bytes, bytes]:
        """Issue a certificate; return it and its new key.

        Args:
            name: Common name, by which access control knows the holder.
            hosts: Names and addresses of a server; none for a person, who is never one.
            days: Validity.
        """
        key = ec.generate_private_key(ec.SECP256R1())
        purposes = [ExtendedKeyUsageOID.CLIENT_AUTH]
        purposes += [ExtendedKeyUsageOID.SERVER_AUTH] if hosts else []
        alternative = [_general_name(host) for host in hosts] or [x509.DNSName(name)]
        authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(self._key.public_key())
        builder = (
            _builder(_name(name), self._certificate.subject, key, days)
            .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
            .add_extension(_usage(is_authority=False), critical=True)
            .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
            .add_extension(x509.SubjectAlternativeName(alternative), critical=False)
            .add_extension(authority, critical=False)
        )
        certificate = builder.sign(self._key, hashes.SHA256())
        return certificate.public_bytes(serialization.Encoding.PEM), _pem(key)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey, days: int
) -> x509.CertificateBuilder:
    now = datetime.now(UTC)
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _BEFORE)
        .not_valid_after(now + timedelta(days=days))
    )


def _name(common_name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _usage(*, is_authority: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not is_authority,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        encipher_only=False,
        decipher_only=False,
    )


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM,
        serialization.PrivateFormat.PKCS8,
        serialization.NoEncryption(),
    )


def _check(directory: Path, access: Access) -> None:
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise KeysError(f"{directory} is not empty: keys are never overwritten; name a new folder")
    for name in access.people:
        if not _NAME.fullmatch(name) or name in (CA, ROUTER, DAEMON):
            raise KeysError(
                f"name {name!r}: 1 to 32 letters, digits, - or _, and not {CA}, {ROUTER}, {DAEMON}"
            )


def _make_folder(path: Path) -> None:
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        path.chmod(0o700)
    except OSError as error:
        raise KeysError(f"cannot make {path}: {error.strerror}") from error


def _write_folder(path: Path, files: dict[str, bytes]) -> None:
    _make_folder(path)
    for name, content in files.items():
        fd = os.open(path / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(fd, "wb") as file:
            file.write(content)
