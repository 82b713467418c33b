# SPDX-License-Identifier: BSD-3-Clause
"""What ships for a lab: certificates and rights that let in whom they should, services whose commands exist."""

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
from calib.live.collect import publish_rig
from calib.rig.rig import Rig
from camera_node.protocol.messages import Detections, Keys, Roundels, decode, encode
from camera_node.protocol.session import open_client
from fusion.client.arena import Arena
from fusion.protocol.messages import FusionStatus
from tests.camera_node.conftest import DEADLINE_S, Inbox, eventually
from tests.conftest import ROOT, free_port

KEYS = Keys("arena")
ROLES = ("camera", "viewer", "operator")
CERTIFICATES = ROOT / "configs" / "zenoh" / "certificates.sh"


class Lab:
    """A server with the configuration that ships, in a process of its own, and sessions of any role."""

    def __init__(self, folder: Path, closing: contextlib.ExitStack) -> None:
        self.folder, self.port, self._closing = folder, free_port(), closing
        subprocess.run(["sh", str(CERTIFICATES), str(folder), "localhost"], check=True, timeout=60)
        home = folder / "server"
        shutil.copytree(ROOT / "configs" / "zenoh", home / "zenoh")
        shutil.copy(ROOT / "configs" / "robots.yaml", home)
        (home / "arena.yaml").write_text(
            f"listen: [tls/127.0.0.1:{self.port}]\nzenoh: zenoh/server.json5\nrobots: robots.yaml\n"
        )
        log = closing.enter_context((folder / "log").open("w"))
        command = [sys.executable, "-m", "fusion", "--config", "arena.yaml"]
        server = subprocess.Popen(command, cwd=home, stderr=log)
        closing.callback(server.wait, 30)
        closing.callback(server.terminate)

    def config(self, role: str) -> Path:
        """member.json5 as it ships, but for the folder that it counts from."""
        text = (ROOT / "configs" / "zenoh" / "member.json5").read_text()
        path = self.folder / f"{role}.json5"
        path.write_text(text.replace('"tls/', f'"{self.folder / role}/tls/'))
        return path

    def session(self, role: str) -> zenoh.Session:
        """One that has reached the server."""
        session = open_client([f"tls/localhost:{self.port}"], self.config(role))
        self._closing.enter_context(session)
        assert eventually(lambda: ask(session, KEYS.clock)), (self.folder / "log").read_text()
        return session


def ask(session: zenoh.Session, key: str, payload: bytes | None = None) -> list[bytes]:
    """What answered a query."""
    replies = session.get(key, payload=payload, timeout=2.0)
    return [reply.ok.payload.to_bytes() for reply in replies if reply.ok]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Lab]:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed; certificates.sh needs it")
    with contextlib.ExitStack() as closing:
        yield Lab(tmp_path_factory.mktemp("lab"), closing)


def heard(session: zenoh.Session, key: str) -> Inbox:
    """What a session hears from now on."""
    inbox = Inbox()
    session.declare_subscriber(
        key, lambda sample: inbox.put((str(sample.key_expr), sample.payload.to_bytes()))
    )
    return inbox


def frame(camera: str) -> bytes:
    roundels = Roundels.from_points(np.array([[1.0, 2.0]]), 0.3)
    return encode(Detections.pack(roundels, camera=camera, seq=1, t_ns=time.time_ns(), width=640, height=480))


def test_a_camera_tells_what_it_sees_and_nothing_else(lab: Lab):
    """What it puts on other keys went before its frame, on one line, and so would be heard before."""
    camera, operator = lab.session("camera"), lab.session("operator")
    inbox, status = heard(operator, "arena/**"), heard(operator, KEYS.fusion_status)

    def speak() -> None:
        for key in (KEYS.rig, KEYS.robot_pose("a"), KEYS.markers, KEYS.fusion_status):
            camera.put(key, b"forged")
        camera.put(KEYS.detections("north"), frame("north"))

    def north_is_known(items: list) -> bool:
        return any("north" in decode(data, FusionStatus).cameras for _, data in items)

    assert eventually(lambda: any(key == KEYS.detections("north") for key, _ in inbox.items), speak)
    assert status.until(north_is_known), "the server heard the frame"
    assert b"forged" not in {data for _, data in inbox.items}


def test_a_camera_is_seen_asked_and_set_by_the_operator_alone(lab: Lab):
    camera, viewer, operator = (lab.session(role) for role in ROLES)
    for key in (KEYS.snapshot("south"), KEYS.settings("south")):
        camera.declare_queryable(key, lambda query, key=key: query.reply(key, b"done"))
    alive = camera.liveliness().declare_token(KEYS.camera_alive("south"))
    for session in (viewer, operator):
        assert eventually(lambda: ask(session, KEYS.snapshot("south")) == [b"done"])  # noqa: B023
        there = session.liveliness().get(KEYS.camera_alive(), timeout=DEADLINE_S)
        assert [str(reply.ok.key_expr) for reply in there if reply.ok] == [KEYS.camera_alive("south")]
    assert ask(operator, KEYS.settings("south")) == [b"done"]
    assert ask(viewer, KEYS.settings("south")) == []
    alive.undeclare()


def test_a_viewer_hears_all_and_changes_nothing(lab: Lab):
    viewer, operator = lab.session("viewer"), lab.session("operator")
    robots = b'{"remove": ["robot_b"]}'
    with Arena.connect(f"tls/localhost:{lab.port}", zenoh_config=lab.config("viewer")) as arena:
        assert arena.status(timeout_s=DEADLINE_S).next().version
    assert ask(viewer, "arena/robots", robots) == []
    before = ask(operator, "arena/robots")
    assert b"robot_b" in before[0], "the viewer's query was not obeyed"
    assert b"robot_b" not in ask(operator, "arena/robots", robots)[0]


def test_the_operator_hands_over_a_rig(lab: Lab):
    operator = lab.session("operator")
    assert publish_rig(operator, "arena", Rig(cameras={}))


@pytest.mark.parametrize("stranger", ["without a certificate", "of another authority"])
def test_strangers_are_kept_out(lab: Lab, stranger: str, tmp_path: Path):
    """TLS 1.3 tells a client that is not wanted when it first reads."""
    lab.session("viewer")  # the server is there
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


def test_certificates_are_added_and_the_authority_kept(tmp_path: Path):
    def make(*names: str) -> dict[Path, bytes]:
        command = ["sh", str(CERTIFICATES), str(tmp_path), "10.0.0.7", *names]
        subprocess.run(command, check=True, timeout=60)
        return {path: path.read_bytes() for path in tmp_path.rglob("*.[pk]e*")}

    first = make("camera")
    second = make("camera", "camera-north")
    assert first.items() <= second.items()
    assert tmp_path / "camera-north" / "tls" / "member.pem" in second
    assert all(path.stat().st_mode & 0o077 == 0 for path in second), "nobody else reads them"


PROGRAMS: dict[str, Callable[[list[str]], object]] = {
    "roundel-fusion": lambda words: tyro.cli(fusion_program.Serve, args=words),
    "roundel-camera": lambda words: tyro.cli(camera_program.Publish, args=words),
    "roundel-web": lambda words: tyro.cli(web_program.Options, args=words),
}
SERVICES = sorted((ROOT / "configs" / "systemd").glob("*.service"))


@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_a_service_starts_a_program_with_options_that_it_has(path: Path):
    """With the options that the file's own comment gives for a camera."""
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
    PROGRAMS[Path(program).name](words)  # SystemExit unless it knows them


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not installed")
@pytest.mark.parametrize("path", SERVICES, ids=lambda path: path.stem)
def test_systemd_knows_every_line_of_a_service(path: Path, tmp_path: Path):
    """Of a copy whose program exists."""
    copy = tmp_path / path.name
    copy.write_text(path.read_text().replace("ExecStart=/opt/roundel/bin/roundel-", "ExecStart=/bin/echo "))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert path.name not in done.stderr, done.stderr
