# SPDX-License-Identifier: BSD-3-Clause
"""The files for a lab: certificates and access rights per role, and the systemd services."""

import configparser
import contextlib
import shlex
import shutil
import socket
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import tyro
import zenoh

import camera_node.__main__ as camera_program
import fusion.__main__ as fusion_program
import web.__main__ as web_program
from calib.live.rig_requests import set_rig
from camera_node.errors import NetworkError
from camera_node.protocol.messages import Detections, Keys, Roundels, decode, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena
from fusion.protocol.messages import FusionStatus
from tests.conftest import ROOT
from tests.waiting import DEADLINE_S, Inbox, wait_for
from tests.web.arena import four_cameras

KEYS = Keys("arena")
ROLES = ("camera", "viewer", "operator")
CERTIFICATES = ROOT / "configs" / "zenoh" / "certificates.sh"


class Lab:
    """A server process with the configuration from configs/zenoh, and sessions of any role."""

    def __init__(self, folder: Path, closing: contextlib.ExitStack) -> None:
        self.folder, self._closing = folder, closing
        subprocess.run(["sh", str(CERTIFICATES), str(folder), "localhost"], check=True, timeout=60)
        home = folder / "server"
        shutil.copytree(ROOT / "configs" / "zenoh", home / "zenoh")
        shutil.copy(ROOT / "configs" / "robots.yaml", home)
        (home / "arena.yaml").write_text(
            "listen: [tls/127.0.0.1:0]\nzenoh: zenoh/server.json5\nrobots: robots.yaml\n"
        )
        log = closing.enter_context((folder / "log").open("w"))
        command = [sys.executable, "-m", "fusion", "--config", "arena.yaml", "--endpoints-file", "endpoints"]
        server = subprocess.Popen(command, cwd=home, stderr=log)
        closing.callback(server.wait, 30)
        closing.callback(server.terminate)
        endpoints = home / "endpoints"
        wait_for(lambda: endpoints.exists() or server.poll() is not None)
        assert endpoints.exists(), (folder / "log").read_text()
        self.port = int(endpoints.read_text().strip().rpartition(":")[2])

    def config(self, role: str) -> Path:
        """member.json5 with absolute paths to the certificates of a role."""
        text = (ROOT / "configs" / "zenoh" / "member.json5").read_text()
        path = self.folder / f"{role}.json5"
        path.write_text(text.replace('"tls/', f'"{self.folder / role}/tls/'))
        return path

    def session(self, role: str) -> zenoh.Session:
        """A session of a role that is connected to the server."""
        session = open_client([f"tls/localhost:{self.port}"], self.config(role))
        self._closing.enter_context(session)
        wait_for(lambda: ask(session, KEYS.clock))
        return session


def ask(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[bytes]:
    """Return the successful replies to a query."""
    replies = session.get(key, payload=payload, timeout=2.0)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed; certificates.sh needs it")
    with contextlib.ExitStack() as closing:
        yield Lab(tmp_path_factory.mktemp("lab"), closing)


def subscribe(session: zenoh.Session, key: str) -> Inbox:
    """Collect key and bytes of all later messages."""
    inbox = Inbox()
    session.declare_subscriber(
        key, lambda sample: inbox.put((str(sample.key_expr), sample.payload.to_bytes()))
    )
    return inbox


def frame(camera: str) -> bytes:
    roundels = Roundels.from_points(np.array([[1.0, 2.0]]), 0.3)
    return encode(Detections.pack(roundels, camera=camera, seq=1, t_ns=time.time_ns(), width=640, height=480))


def test_a_camera_may_publish_detections_only(lab: Lab):
    """It puts forged messages on other keys before its frame, so they would arrive before it."""
    camera, operator = lab.session("camera"), lab.session("operator")
    inbox, status = subscribe(operator, "arena/**"), subscribe(operator, KEYS.fusion_status)

    def put_all() -> None:
        for key in (KEYS.rig, KEYS.robot_pose("a"), KEYS.markers, KEYS.fusion_status):
            camera.put(key, b"forged")
        camera.put(KEYS.detections("north"), frame("north"))

    def north_is_known(items: list) -> bool:
        return any("north" in decode(data, FusionStatus).cameras for _, data in items)

    wait_for(lambda: any(key == KEYS.detections("north") for key, _ in inbox.items), put_all)
    assert status.until(north_is_known), "the server received the frame"
    assert b"forged" not in {data for _, data in inbox.items}


def test_only_the_operator_may_change_a_camera(lab: Lab):
    """A viewer and the operator may request a snapshot; only the operator may change settings."""
    camera, viewer, operator = (lab.session(role) for role in ROLES)
    for key in (KEYS.snapshot("south"), KEYS.settings("south")):
        camera.declare_queryable(key, lambda query, key=key: query.reply(key, b"done"))
    alive = camera.liveliness().declare_token(KEYS.camera_alive("south"))
    for session in (viewer, operator):
        wait_for(lambda: ask(session, KEYS.snapshot("south")) == [b"done"])  # noqa: B023
        tokens = session.liveliness().get(KEYS.camera_alive(), timeout=DEADLINE_S)
        assert [str(reply.ok.key_expr) for reply in tokens if reply.ok] == [KEYS.camera_alive("south")]
    assert ask(operator, KEYS.settings("south")) == [b"done"]
    assert ask(viewer, KEYS.settings("south")) == []
    alive.undeclare()


def test_a_viewer_may_receive_all_and_change_nothing(lab: Lab):
    viewer, operator = lab.session("viewer"), lab.session("operator")
    robots = b'{"remove": ["robot_b"]}'
    with Arena.connect(f"tls/localhost:{lab.port}", zenoh_config=lab.config("viewer")) as arena:
        assert arena.status(timeout_s=DEADLINE_S).next().version
    assert ask(viewer, "arena/robots/set", robots) == []
    before = ask(operator, "arena/robots")
    assert b"robot_b" in before[0], "the server rejected the viewer's request"
    assert b"robot_b" not in ask(operator, "arena/robots/set", robots)[0]


def test_only_the_operator_may_change_the_rig(lab: Lab):
    """A camera and a viewer find no server that answers."""
    for role in ("camera", "viewer"):
        with pytest.raises(NetworkError, match="no server answers"):
            set_rig(lab.session(role), "arena", four_cameras(), "test", timeout_s=0.5)
    assert set_rig(lab.session("operator"), "arena", four_cameras(), "test").rig == four_cameras()


@pytest.mark.parametrize("stranger", ["without a certificate", "of another authority"])
def test_clients_without_a_valid_certificate_are_rejected(lab: Lab, stranger: str, tmp_path: Path):
    """TLS 1.3 rejects a client when it first reads."""
    lab.session("viewer")  # the server is running
    context = ssl.create_default_context(cafile=str(lab.folder / "authority.pem"))
    if stranger == "of another authority":
        subprocess.run(
            ["sh", str(CERTIFICATES), str(tmp_path), "localhost", "operator"], check=True, timeout=60
        )
        own = tmp_path / "operator" / "tls"
        context.load_cert_chain(own / "member.pem", own / "member.key")
    plain = socket.create_connection(("127.0.0.1", lab.port), timeout=DEADLINE_S)
    with (
        plain,
        pytest.raises(ssl.SSLError, match="alert"),
        context.wrap_socket(plain, server_hostname="localhost") as tls,
    ):
        tls.recv(1)


def test_new_certificates_use_the_same_authority(tmp_path: Path):
    def make(*names: str) -> dict[Path, bytes]:
        command = ["sh", str(CERTIFICATES), str(tmp_path), "10.0.0.7", *names]
        subprocess.run(command, check=True, timeout=60)
        return {path: path.read_bytes() for path in tmp_path.rglob("*.[pk]e*")}

    first = make("camera")
    second = make("camera", "camera-north")
    assert first.items() <= second.items()
    assert tmp_path / "camera-north" / "tls" / "member.pem" in second
    assert all(path.stat().st_mode & 0o077 == 0 for path in second), "only the owner can read the keys"


PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "roundel-fusion": lambda words: tyro.cli(fusion_program.Serve, args=words),
    "roundel-camera": lambda words: tyro.cli(camera_program.Publish, args=words),
    "roundel-web": lambda words: tyro.cli(web_program.Options, args=words),
}
SERVICES = sorted((ROOT / "configs" / "systemd").glob("*.service"))


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_a_service_starts_a_program_with_valid_options(path: Path):
    """A camera's options come from the example in the comment of the file."""
    unit = configparser.RawConfigParser(strict=True)
    unit.optionxform = str  # pyright: ignore[reportAttributeAccessIssue] as configparser documents it
    unit.read(path)
    program, *words = shlex.split(unit["Service"]["ExecStart"].replace("%i", "north"))
    if "$ROUNDEL_CAMERA" in words:
        (options,) = [
            line for line in path.read_text().splitlines() if line.startswith("#   ROUNDEL_CAMERA=")
        ]
        words = [*words[: words.index("$ROUNDEL_CAMERA")], *shlex.split(options.partition("=")[2])]
    assert Path(program).parent == Path("/opt/roundel/bin")
    PROGRAMS[Path(program).name](words)  # SystemExit if an option is unknown


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_systemd_accepts_a_service(path: Path, tmp_path: Path):
    """`systemd-analyze verify` of a copy with an existing program."""
    copy = tmp_path / path.name
    copy.write_text(path.read_text().replace("ExecStart=/opt/roundel/bin/roundel-", "ExecStart=/bin/echo "))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert path.name not in done.stderr, done.stderr
