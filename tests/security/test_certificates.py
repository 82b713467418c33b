# SPDX-License-Identifier: BSD-3-Clause
"""certificates.sh: creation, renewal and revocation, with real sessions."""

import contextlib
import shutil
import socket
import ssl
import subprocess
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from camera_node.foundation.errors import NetworkError
from camera_node.protocol.session import listening_endpoints, open_client, open_router
from tests.security.lab import CONFIGS, KEYS, Lab, certificates
from tests.waiting import DEADLINE_S, Inbox, slowness, wait_for

DAY_S = 86_400
ANSWER_S = 2.0
REVOCATION_S = 60.0
EXPIRY_S = 5.0  # enough to connect on a busy machine


def read(path: Path, *options: str) -> str:
    """What openssl shows of a certificate."""
    command = ["openssl", "x509", "-noout", "-in", str(path), *options]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout.strip()


def member(folder: Path, name: str) -> Path:
    return folder / name / "tls" / "member.pem"


def expires_within(path: Path, days: int) -> bool:
    command = ["openssl", "x509", "-noout", "-in", str(path), "-checkend", str(days * DAY_S)]
    return subprocess.run(command, capture_output=True, check=False, timeout=60).returncode == 1


def files(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob("*.[pk]e*")}


def test_each_camera_has_a_certificate_for_one_year(tmp_path: Path):
    certificates(tmp_path, "10.0.0.7", "camera.north", "camera.south-2", "viewer").check_returncode()
    for name in ("camera.north", "camera.south-2", "viewer", "server"):
        certificate = member(tmp_path, name)
        assert read(certificate, "-subject").endswith(f"CN = {name}")
        assert expires_within(certificate, 366)
        assert not expires_within(certificate, 364)
    assert "10.0.0.7" in read(member(tmp_path, "server"), "-ext", "subjectAltName")
    assert all(path.stat().st_mode & 0o077 == 0 for path in files(tmp_path)), (
        "only the owner can read the keys"
    )


def test_a_second_run_adds_certificates_and_rules(tmp_path: Path):
    certificates(tmp_path, "server.lab", "camera.north").check_returncode()
    first = files(tmp_path)
    certificates(tmp_path, "server.lab", "camera.south").check_returncode()
    assert first.items() <= files(tmp_path).items()
    rules = zenoh.Config.from_file(str(tmp_path / "server" / "zenoh" / "server.json5")).get_json(
        "access_control"
    )
    assert {"*/camera/north/alive", "*/camera/south/alive"} <= set(rules.split('"'))


def test_another_host_gets_another_server_certificate(tmp_path: Path):
    certificates(tmp_path, "old.lab", "viewer").check_returncode()
    before = files(tmp_path)
    certificates(tmp_path, "new.lab", "viewer").check_returncode()
    assert "new.lab" in read(member(tmp_path, "server"), "-ext", "subjectAltName")
    assert before[member(tmp_path, "viewer")] == member(tmp_path, "viewer").read_bytes()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["{}", "host", "camera"], "each camera has its own certificate"),
        (["{}", "host", "server"], "is no certificate's name"),
        (["{}", "host", "camera.a/b"], "use letters, digits"),
        (["{}", "host", "camera.*"], "use letters, digits"),
        (["{}", "host", "camera." + "x" * 60], "at most 62"),
        (["{}"], "give FOLDER and more"),
        (["--delete", "{}", "host"], "unknown option"),
        (["--renew", "{}"], "check FOLDER"),
        (["--revoke", "{}", "viewer"], "check FOLDER"),
    ],
)
def test_a_wrong_call_is_refused_in_one_line(tmp_path: Path, words: list[str], reason: str):
    done = certificates(*(word.format(tmp_path / "keys") for word in words))
    assert done.returncode == 2
    assert reason in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "keys").exists(), "nothing is written"


def test_an_unknown_certificate_cannot_be_revoked(tmp_path: Path):
    certificates(tmp_path, "host", "camera.north").check_returncode()
    before = files(tmp_path)
    done = certificates("--revoke", tmp_path, "camera.north", "camera.nort")
    assert done.returncode == 2
    assert "no certificate of camera.nort" in done.stderr
    assert files(tmp_path) == before


@contextlib.contextmanager
def collecting(lab: Lab, key: str) -> Iterator[Inbox]:
    """The payloads that a server's session, which has all rights, receives on a key."""
    inbox = Inbox()
    session = lab.session("server")
    subscriber = session.declare_subscriber(key, lambda sample: inbox.put(sample.payload.to_bytes()))
    yield inbox
    subscriber.undeclare()


def has_rights(session: zenoh.Session) -> bool:
    """Whether the server answers."""
    return any(reply.ok for reply in session.get(KEYS.clock, timeout=ANSWER_S))


def require_rights(*sessions: zenoh.Session) -> None:
    """Wait for the server's answers: a new session does not know its queryables at once."""
    for session in sessions:
        wait_for(lambda: has_rights(session))  # noqa: B023


@pytest.mark.ci
def test_renewal_replaces_certificates_while_old_ones_are_valid(tmp_path: Path):
    """The server runs with its old certificate and rules, then with the new ones."""
    names = ("camera.north", "viewer")
    certificates(tmp_path, "localhost", *names).check_returncode()
    for name in names:
        shutil.copytree(tmp_path / name, tmp_path / f"old-{name}")
    before = files(tmp_path)
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path, closing)
        certificates("--renew", tmp_path).check_returncode()
        renewed = {path for path, data in files(tmp_path).items() if before.get(path) != data}
        certificate = {member(tmp_path, name) for name in ("server", *names)}
        assert renewed == certificate | {path.with_suffix(".key") for path in certificate}
        require_rights(*map(lab.session, (*names, "old-viewer")))
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path, closing)
        require_rights(*map(lab.session, (*names, "old-camera.north", "old-viewer")))


@pytest.mark.ci
def test_a_revoked_certificate_has_no_rights_and_its_successor_has(tmp_path: Path):
    """While the server runs: the thief of a camera's key can connect, and neither publish, nor ask, nor receive.

    Before, the rights lasted until somebody started the server again.
    """
    certificates(tmp_path, "localhost", "camera.north", "viewer").check_returncode()
    shutil.copytree(tmp_path / "camera.north", tmp_path / "stolen")
    key = KEYS.detections("north")
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path, closing)
        inbox = closing.enter_context(collecting(lab, key))
        thief = lab.session("stolen")
        require_rights(thief)
        certificates("--revoke", tmp_path, "camera.north").check_returncode()
        revoked_s = time.monotonic()
        wait_for(lambda: not has_rights(thief))
        assert time.monotonic() - revoked_s < REVOCATION_S
        certificates(tmp_path, "localhost", "camera.north").check_returncode()
        camera = lab.session("camera.north")
        thief.put(key, b"forged")
        require_rights(camera)
        assert not has_rights(thief)
        wait_for(lambda: b"true" in inbox.items, lambda: camera.put(key, b"true"))
        assert set(inbox.items) == {b"true"}


def test_a_revoked_camera_has_no_rule(tmp_path: Path):
    certificates(tmp_path, "localhost", "camera.north", "camera.south").check_returncode()
    certificates("--revoke", tmp_path, "camera.north").check_returncode()
    text = (tmp_path / "server" / "zenoh" / "server.json5").read_text()
    assert "south" in text
    assert "north" not in text


def with_certificate(keys: Path, template: str, name: str) -> Path:
    """The links of the Zenoh configuration `template`, without rules, with the certificate of `name`."""
    path = keys / f"{name}-{template}"
    links, rules, _ = (CONFIGS / template).read_text().partition("access_control")
    path.write_text(links.replace('"tls/', f'"{keys / name}/tls/') + ("}" if rules else ""))
    return path


def test_only_the_server_s_certificate_makes_a_server(tmp_path: Path):
    """Clients and servers of other zones connect to no program that listens with the certificate of another role."""
    certificates(tmp_path, "localhost", "camera.north", "viewer").check_returncode()
    listen = ["tls/127.0.0.1:0"]
    for listener in ("server", "camera.north", "viewer"):
        with open_router(listen, with_certificate(tmp_path, "server.json5", listener)) as router:
            for client in ("viewer", "server"):
                given = (
                    listening_endpoints(router, listen),
                    with_certificate(tmp_path, "member.json5", client),
                )
                if listener == "server":
                    open_client(*given, DEADLINE_S).close()
                else:
                    with pytest.raises(NetworkError):
                        open_client(*given, 0.3 * slowness())


def handshake(lab: Lab, folder: Path) -> None:
    """Connect with the certificate in `folder`, or without one; TLS 1.3 rejects a client when it first reads."""
    context = ssl.create_default_context(cafile=str(lab.folder / "authority.pem"))
    if folder.exists():
        context.load_cert_chain(folder / "member.pem", folder / "member.key")
    plain = socket.create_connection(("127.0.0.1", lab.port), timeout=DEADLINE_S)
    with plain, context.wrap_socket(plain, server_hostname="localhost") as tls:
        tls.settimeout(1.0)
        with contextlib.suppress(TimeoutError):
            tls.recv(1)


def test_clients_without_a_valid_certificate_are_rejected(tmp_path: Path):
    """Without one, with one of another authority, and with one that expired yesterday."""
    certificates(tmp_path / "keys", "localhost", "viewer").check_returncode()
    certificates(tmp_path / "other", "localhost", "viewer").check_returncode()
    expired = tmp_path / "expired"
    shutil.copytree(tmp_path / "keys" / "viewer" / "tls", expired)
    request = [
        "req",
        "-new",
        "-key",
        expired / "member.key",
        "-subj",
        "/CN=viewer",
        "-out",
        expired / "request",
    ]
    sign = ["x509", "-req", "-in", expired / "request", "-CA", tmp_path / "keys" / "authority.pem"]
    sign += ["-CAkey", tmp_path / "keys" / "authority.key", "-days", "-1", "-out", expired / "member.pem"]
    for command in (request, sign):
        subprocess.run(["openssl", *map(str, command)], check=True, capture_output=True, timeout=60)
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path / "keys", closing)
        handshake(lab, tmp_path / "keys" / "viewer" / "tls")
        for folder in (tmp_path / "none", tmp_path / "other" / "viewer" / "tls", expired):
            with pytest.raises(ssl.SSLError, match="alert"):
                handshake(lab, folder)


AUTHORITY_CONF = """[ca]
default_ca = lab
[lab]
database = index
serial = serial
new_certs_dir = .
certificate = {keys}/authority.pem
private_key = {keys}/authority.key
default_md = sha256
policy = any
x509_extensions = client
[any]
commonName = supplied
[client]
extendedKeyUsage = clientAuth
"""


def sign_until(keys: Path, folder: Path, end: datetime) -> None:
    """Replace the certificate in `folder` by one that expires at `end`."""
    (folder / "ca.conf").write_text(AUTHORITY_CONF.format(keys=keys))
    (folder / "index").touch()
    (folder / "serial").write_text("1000\n")
    request = ["req", "-new", "-key", "member.key", "-subj", "/CN=viewer", "-out", "request"]
    sign = ["ca", "-batch", "-config", "ca.conf", "-in", "request", "-out", "member.pem", "-notext"]
    for command in (request, [*sign, "-enddate", f"{end:%Y%m%d%H%M%SZ}"]):
        subprocess.run(["openssl", *command], cwd=folder, check=True, capture_output=True, timeout=60)


def test_the_server_closes_a_connection_when_the_certificate_expires(tmp_path: Path):
    certificates(tmp_path, "localhost", "viewer").check_returncode()
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path, closing)
        end = datetime.now(UTC) + timedelta(seconds=EXPIRY_S)
        sign_until(tmp_path, tmp_path / "viewer" / "tls", end)
        session = lab.bare_session("viewer", "client")
        assert session.info.routers_zid()
        wait_for(lambda: not session.info.routers_zid())
        assert datetime.now(UTC) > end - timedelta(seconds=1), "the certificate has whole seconds"
