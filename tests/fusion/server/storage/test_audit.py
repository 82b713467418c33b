# SPDX-License-Identifier: BSD-3-Clause
"""Each change over the network leaves a line that says what is proven and what is claimed of its sender."""

import contextlib
import json
import logging
import shutil
from pathlib import Path

import msgspec
import pytest

from calib.live.rig_requests import set_rig, step_rig
from calib.rig.rig import Rig
from camera_node.foundation.errors import RoundelError
from camera_node.protocol.requests import RequestSource
from fusion.protocol.pose_messages import RobotsRequest
from fusion.protocol.robot_requests import change_robots
from fusion.server.storage.audit import MAX_OLD, REFUSED_BURST, AuditFile, quote
from tests.conftest import ROOT
from tests.fusion.serving import config, serving
from tests.fusion.synthetic import WIDE
from tests.security.lab import ARENA, Lab, certificates
from tests.waiting import wait_for

pytestmark = pytest.mark.computed


def lines(path: Path) -> list[dict]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_changes_and_refusals_are_noted_with_the_certificate(tmp_path: Path):
    """The name in the certificate is proven by TLS; a viewer's request never arrives."""
    done = certificates(tmp_path, "localhost", "operator.ann", "viewer")
    assert done.returncode == 0, done.stderr
    home, audit = tmp_path / "server", tmp_path / "server" / "audit.jsonl"
    shutil.copy(ROOT / "configs" / "robots.yaml", home)
    (home / "arena.yaml").write_text(
        "listen: [tls/127.0.0.1:0]\nzenoh: zenoh/server.json5\nrobots: robots.yaml\naudit: audit.jsonl\n"
    )
    with contextlib.ExitStack() as closing:
        lab = Lab(tmp_path, closing)
        operator, viewer = lab.session("operator.ann"), lab.session("viewer")
        change_robots(operator, ARENA, RobotsRequest(remove=("robot_b",)))
        with pytest.raises(RoundelError, match="robot_b"):
            change_robots(operator, ARENA, RobotsRequest(remove=("robot_b",)))
        with pytest.raises(RoundelError):
            change_robots(viewer, ARENA, RobotsRequest(remove=("robot_a",)), timeout_s=0.5)
        wait_for(lambda: audit.exists() and len(lines(audit)) == 2)
        first, second = lines(audit)
    assert first["change"] == "change of robots"
    assert first["outcome"] == "done"
    assert first["request"]["remove"] == ["robot_b"]
    assert first["certificate"] == second["certificate"] == "operator.ann"
    assert first["address"].startswith("tls/127.0.0.1:")
    assert first["claimed_session"] == str(operator.info.zid())
    assert second["outcome"].startswith("refused: ")


def test_without_certificates_the_address_is_known(tmp_path: Path):
    """And a file that can't be written prevents no change."""
    audit = tmp_path / "audit.jsonl"
    settings = msgspec.structs.replace(config(tmp_path), audit=str(audit))
    with serving(settings) as (_, client):
        client.change_robots(define={"b": WIDE})
        (line,) = lines(audit)
        assert line["certificate"] is None
        assert line["address"].startswith("tcp/127.0.0.1:")
        assert list(line["request"]["define"]) == ["b"]
        assert line["claimed_source"]["program"] == "fusion.client"
        audit.unlink()
        audit.mkdir()
        assert "b" not in client.change_robots(remove=["b"])


def test_refused_requests_do_not_fill_the_file(tmp_path: Path):
    """They are noted at a bounded rate, and counted; a change among them is noted at once."""
    audit = tmp_path / "audit.jsonl"
    settings = msgspec.structs.replace(config(tmp_path), audit=str(audit))
    with serving(settings) as (_, client):
        for _ in range(REFUSED_BURST + 5):
            with pytest.raises(RoundelError):
                client.change_robots(remove=["unknown"])
        client.change_robots(remove=["a"])
        outcomes = [line["outcome"].partition(":")[0] for line in lines(audit)]
    assert outcomes[-1] == "done"
    assert REFUSED_BURST <= outcomes.count("refused") < REFUSED_BURST + 5


def test_the_files_are_bounded_and_have_the_last_lines(tmp_path: Path):
    """The oldest lines are removed, no line is lost between two files, and none is split."""
    file = AuditFile(tmp_path / "audit.jsonl", max_bytes=100)
    for number in range(100):
        file.append(b"%030d" % number)
    paths = [tmp_path / "audit.jsonl", *(tmp_path / f"audit.jsonl.{k + 1}" for k in range(MAX_OLD))]
    assert sorted(tmp_path.iterdir()) == sorted(paths)
    assert all(path.stat().st_size <= 100 for path in paths)
    written = [int(line) for path in reversed(paths) for line in path.read_text().split()]
    assert written == list(range(100 - len(written), 100))
    assert len(written) > 3 * MAX_OLD


@pytest.mark.parametrize(
    "payload", [b"", b"\xc1", b"{", b"[" * 50_000, b"\x81\xa1x\xc4\x04abcd", b'{"a": NaN}']
)
def test_any_request_can_be_quoted(payload: bytes):
    assert len(msgspec.json.encode(quote(payload))) < 200


def test_changes_of_the_rig_are_noted_with_their_claimed_source(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """A change, its undo and its redo; in the log, the source in words."""
    caplog.set_level(logging.INFO, "fusion.audit")
    audit = tmp_path / "audit.jsonl"
    settings = msgspec.structs.replace(config(tmp_path), audit=str(audit))
    with serving(settings) as (server, client):
        rig = server.pipeline.active_rig.rig
        assert rig is not None
        cameras = {name: rig.cameras[name] for name in sorted(rig.cameras)[:3]}
        set_rig(client.session, "test", Rig(cameras=cameras), "calib wand")
        step_rig(client.session, "test", "undo", "calib undo")
        step_rig(client.session, "test", "redo", "calib redo")
    assert [(line["change"], line["claimed_source"]["program"]) for line in lines(audit)] == [
        ("change of the rig", "calib wand"),
        ("undo of the rig", "calib undo"),
        ("redo of the rig", "calib redo"),
    ]
    assert f"(claims to be {RequestSource.of('calib undo')}): done" in caplog.text
