# SPDX-License-Identifier: BSD-3-Clause
"""The rig in force: changed by requests, undone, redone, saved; a fault of either leaves the one before."""

import logging
import os
import re
import shutil
import time
from pathlib import Path

import msgspec
import pytest

from calib.live.rig_requests import set_rig, step_rig
from calib.rig.file_history import MAX_OLD, History
from calib.rig.rig import Rig, dump_rig, load_rig, save_rig
from calib.rig.rig_messages import RigHistory, SavedChange
from camera_node.foundation.errors import NetworkError
from camera_node.geometry.pose import Pose
from camera_node.protocol.camera_requests import change_camera
from camera_node.protocol.messages import encode
from camera_node.protocol.registration import CameraChange, CameraRegistration, register_key
from camera_node.protocol.requests import RequestError, send_request
from camera_node.protocol.server_connection import Connection
from camera_node.protocol.session import open_router
from fusion.client.arena import Arena as Client
from fusion.commands.history import history
from fusion.model.corrections import ExtrinsicsCorrection, RigRefinement, corrected_cameras
from fusion.protocol.pose_messages import Robots, robots_key
from fusion.server.arena_config import ArenaConfig
from fusion.server.storage.active_rig import ActiveRig
from tests.fusion.serving import ARENA, config, connected, send_until_tracked, serving, zones_of
from tests.processes import run_program
from tests.waiting import DEADLINE_S, wait_for

pytestmark = pytest.mark.computed

GIVEN = Rig(cameras=ARENA.cameras)
FEWER = Rig(cameras={name: ARENA.cameras[name] for name in ("cam0", "cam1")})
MOVED = msgspec.structs.replace(ARENA.cameras["cam1"], T_world_cam=Pose((0, 0, 2), (1, 0, 0, 0)))


def numbered(k: int) -> Rig:
    """A rig that differs from others in the offset of one clock."""
    camera = msgspec.structs.replace(ARENA.cameras["cam0"], time_offset_ms=float(k))
    return Rig(cameras={**ARENA.cameras, "cam0": camera})


def saving(folder: Path, with_rig: bool = True) -> ArenaConfig:
    """A server that saves changes of the rig."""
    return msgspec.structs.replace(config(folder, with_rig), saved_rig=str(folder / "rig.saved.yaml"))


def offset_of(rig: Rig | None) -> float:
    assert rig is not None
    return rig.cameras["cam0"].time_offset_ms


def test_a_requested_rig_is_in_force_and_used_after_a_restart(tmp_path: Path):
    settings = saving(tmp_path, with_rig=False)
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) is None
        reply = client.set_rig(GIVEN)
        assert (reply.rig, reply.saved) == (GIVEN, True)
        assert client.rig(DEADLINE_S) == GIVEN
        assert reply.source is not None
        assert reply.source.program == "fusion.client"
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == GIVEN


def test_a_server_that_saves_nothing_says_so_and_undoes_all_the_same(tmp_path: Path):
    with serving(config(tmp_path)) as (_, client):
        assert not client.set_rig(FEWER).saved
        assert client.undo_rig().rig == GIVEN
        assert client.redo_rig().rig == FEWER
        with pytest.raises(RequestError, match="no undone version"):
            client.redo_rig()
    assert not list(tmp_path.glob("rig.*.yaml"))


def test_subscribers_receive_the_rig_of_the_server_only(tmp_path: Path):
    """A rig that somebody else publishes has no effect on the server."""
    with serving(config(tmp_path)) as (server, client), connected(server) as other:
        received = []
        subscriber = other.session.declare_subscriber(server.keys.rig, received.append)
        wait_for(lambda: client.set_rig(FEWER) and received)
        other.session.put(server.keys.rig, received[0].payload)
        client.set_rig(GIVEN)
        assert client.rig(DEADLINE_S) == GIVEN
        subscriber.undeclare()


def test_robots_stay_tracked_if_no_pose_or_that_of_one_camera_changes(tmp_path: Path):
    with serving(config(tmp_path)) as (server, client):
        send_until_tracked(server, client, ARENA.messages(30))
        tracker = server.pipeline.tracker
        assert tracker is not None
        client.set_rig(Rig(cameras=ARENA.cameras, calibration={"date": "today"}))
        client.set_rig(numbered(1))
        assert server.pipeline.tracker is tracker
        assert tracker.table.status == ["tracked"]
        client.set_rig(FEWER)
        assert server.pipeline.tracker is not tracker


def test_a_rig_that_cannot_be_saved_is_refused_and_the_old_one_stays(tmp_path: Path):
    """Applied first, then rolled back: tracking continues with the old rig, and the server keeps running."""
    (tmp_path / "saved").mkdir()
    settings = msgspec.structs.replace(config(tmp_path), saved_rig=str(tmp_path / "saved" / "rig.yaml"))
    with serving(settings) as (server, client):
        shutil.rmtree(tmp_path / "saved")
        for rig in (FEWER, numbered(1)):
            with pytest.raises(RequestError, match=r"saved/rig\.yaml can't be"):
                client.set_rig(rig)
            assert client.rig(DEADLINE_S) == GIVEN
            assert server.pipeline.cameras == ARENA.cameras
        send_until_tracked(server, client, ARENA.messages(30))


def test_changes_are_undone_and_redone_also_after_a_restart(tmp_path: Path):
    settings = saving(tmp_path)
    with serving(settings) as (_, client):
        for k in (1, 2, 3):
            client.set_rig(numbered(k))
        assert [offset_of(client.undo_rig().rig) for _ in range(2)] == [2, 1]
    with serving(settings) as (_, client):
        assert offset_of(client.rig(DEADLINE_S)) == 1
        assert offset_of(client.undo_rig().rig) == 0, "the rig of the configuration"
        with pytest.raises(
            RequestError, match=r"no earlier version of .*rig\.saved\.yaml; nothing was changed"
        ):
            client.undo_rig()
        assert [offset_of(client.redo_rig().rig) for _ in range(3)] == [1, 2, 3]
        with pytest.raises(RequestError, match="no undone version"):
            client.redo_rig()


def test_undo_of_a_correction_restores_the_camera_and_no_longer_monitors_it(tmp_path: Path):
    with serving(saving(tmp_path)) as (server, client):
        with pytest.raises(RequestError, match="no earlier version"):
            client.undo_rig()
        server.transport.enqueue(
            lambda: server.pipeline.active_rig.correct(ExtrinsicsCorrection("cam1", MOVED), 1)
        )
        wait_for(lambda: (rig := client.rig(DEADLINE_S)) and rig.cameras["cam1"] == MOVED)
        where = ("--connect", server.endpoints[0], "--arena", "test")
        done = run_program("fusion", "undo", *where)
        assert re.fullmatch(
            r"undone on the server: cam1 [\d.]+ mm \(.*, by the server\); changed cameras: cam1; cam1 is no longer "
            "monitored\n",
            done.stdout,
        )
        assert client.rig(DEADLINE_S) == GIVEN
        assert server.pipeline.tracker is not None
        assert server.pipeline.tracker.monitors.rig.pinned == {"cam1"}
        done = run_program("fusion", "redo", *where)
        assert re.fullmatch(r"redone on the server: cam1 .* mm \(.*\); changed cameras: cam1\n", done.stdout)
        done = run_program("fusion", "redo", *where)
        assert (done.returncode, "no undone version" in done.stderr) == (2, True)


def test_undo_of_a_refinement_restores_the_rig_and_no_longer_refines_it(tmp_path: Path):
    """Moved cameras are found as before; a new calibration may be refined again."""
    with serving(saving(tmp_path)) as (server, client):
        cameras = dict(ARENA.cameras) | {"cam1": MOVED}
        refinement = RigRefinement(cameras, "cam1", 0.2, (0.0,) * 8)
        server.transport.enqueue(lambda: server.pipeline.correct_rig(refinement, 1))
        wait_for(lambda: (rig := client.rig(DEADLINE_S)) and rig.cameras["cam1"] == MOVED)
        where = ("--connect", server.endpoints[0], "--arena", "test")
        done = run_program("fusion", "undo", *where)
        assert "the rig is not refined any more" in done.stdout
        restored, tracker = client.rig(DEADLINE_S), server.pipeline.tracker
        assert restored is not None
        assert restored.cameras["cam1"] == ARENA.cameras["cam1"]
        assert tracker is not None
        assert not tracker.monitors.rig.refines
        assert tracker.monitors.rig.pinned == set()
        client.set_rig(Rig(cameras=cameras))
        tracker = server.pipeline.tracker
        assert tracker is not None
        assert tracker.monitors.rig.refines


@pytest.mark.parametrize(
    ("entry", "names"),
    [({"camera": "cam1", "t_ns": 5}, ["cam1"]), ({"cameras": ["cam1", 3]}, ["cam1"]), ("cam1", []), ({}, [])],
)
def test_the_entry_of_corrected_cameras_is_read_as_older_servers_wrote_it_or_anything(
    entry, names: list[str]
):
    before = Rig(cameras=ARENA.cameras)
    assert (
        corrected_cameras(msgspec.structs.replace(before, calibration={"corrected": entry}), before) == names
    )


@pytest.mark.parametrize("with_rig", [True, False], ids=["configured", "saved"])
def test_an_undo_after_a_rename_undoes_the_calibration_and_keeps_the_name(tmp_path: Path, with_rig: bool):
    """In every version, also after a restart; a version with an entry of that name, which no camera has, loses it."""
    settings = saving(tmp_path, with_rig)
    old = {**ARENA.cameras, "door": ARENA.cameras["cam1"]}
    with serving(settings) as (_, client):
        client.set_rig(Rig(cameras=old))
        client.set_rig(numbered(1))
        client.set_rig(numbered(2))
        client.undo_rig()
        registration = encode(CameraRegistration(id="usb-1", name="cam0"))
        send_request(client.session, register_key("test"), registration, DEADLINE_S)
        before = client.rig_history().versions
        change_camera(client.session, "test", CameraChange(camera="cam0", name="door"), DEADLINE_S)
        after = client.rig_history().versions
        assert [(v.state, v.t_ns, v.change) for v in after] == [(v.state, v.t_ns, v.change) for v in before]
        assert offsets(client.rig(DEADLINE_S)) == {"door": 1, "cam1": 0, "cam2": 0, "cam3": 0}
    with serving(settings) as (_, client):
        assert offsets(client.undo_rig().rig) == {"door": 0, "cam1": 0, "cam2": 0, "cam3": 0}
        assert [offsets(client.redo_rig().rig)["door"] for _ in range(2)] == [1, 2]


def offsets(rig: Rig | None) -> dict[str, float]:
    assert rig is not None
    return {name: camera.time_offset_ms for name, camera in rig.placed().items()}


def states(client: Client) -> list[tuple[str, str, str]]:
    """State, change and file of each version."""
    return [(v.state, v.change, v.file) for v in client.rig_history().versions]


def test_the_history_names_each_version(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """With its time and sender, also after a restart; an undone version stays in the list."""
    settings = saving(tmp_path, with_rig=False)
    with serving(settings) as (_, client):
        assert client.rig_history() == RigHistory()
        client.set_rig(GIVEN)
        before_ns = time.time_ns()
        client.set_rig(numbered(1))
        client.set_rig(FEWER)
        client.undo_rig()
    with serving(settings) as (server, client):
        assert states(client) == [
            ("earlier", f"{len(GIVEN.cameras)} cameras placed", "rig.saved.1.yaml"),
            ("in force", "clock offset of cam0", "rig.saved.yaml"),
            ("undone", "cam2, cam3 not placed, clock offset of cam0", "rig.saved.undone.1.yaml"),
        ]
        versions = client.rig_history().versions
        assert [version.source and version.source.program for version in versions] == ["fusion.client"] * 3
        assert 0 < versions[1].t_ns - before_ns < 60 * 10**9
        history(connection=Connection(connect=tuple(server.endpoints), arena="test"))
    lines = capsys.readouterr().out.splitlines()
    assert ["clock offset of cam0, by fusion.client of" in line for line in lines] == [False, True, True]


def test_a_history_without_files(tmp_path: Path):
    """Of a server that saves nothing: the rig of the configuration, then its changes."""
    with serving(config(tmp_path)) as (_, client):
        placed = f"{len(GIVEN.cameras)} cameras placed"
        assert states(client) == [("in force", placed, "")]
        client.set_rig(numbered(1))
        assert states(client) == [("earlier", placed, ""), ("in force", "clock offset of cam0", "")]


@pytest.mark.parametrize("step", ["set", "undo"])
def test_a_file_that_the_sender_wrote_before_is_one_step(tmp_path: Path, step: str):
    """`calib wand --live --out` and `calib undo --live` write the file in which the server saves its rig."""
    settings = saving(tmp_path, with_rig=False)
    path = Path(settings.saved_rig or "")
    with serving(settings) as (_, client):
        client.set_rig(numbered(1))
        client.set_rig(numbered(2))
        if step == "set":
            save_rig(numbered(3), path)
        else:
            History(path).take("undo")
        client.set_rig(load_rig(path))
        offsets = [offset_of(load_rig(tmp_path / version.file)) for version in client.rig_history().versions]
        assert offsets == ([1, 2, 3] if step == "set" else [1, 2])


def loaded(given: Path, saved: Path) -> Rig | None:
    active = ActiveRig(given, saved)
    active.load(lambda rig: None)
    return active.rig


def test_corrections_of_moved_cameras_displace_no_calibration(tmp_path: Path):
    """The history ended at a correction after the twentieth."""
    active = ActiveRig(None, tmp_path / "rig.saved.yaml")
    for k in range(3):
        active.save(numbered(k), k)
        active.use(numbered(k), k)
    moved = []
    for k in range(2 * MAX_OLD):
        pose = Pose((0.0, 0.0, float(k)), (1.0, 0.0, 0.0, 0.0))
        active.correct(ExtrinsicsCorrection("cam1", msgspec.structs.replace(MOVED, T_world_cam=pose)), k)
        assert active.rig is not None
        moved.append(dump_rig(active.rig))
    states = [load_rig(path) for path in History(tmp_path / "rig.saved.yaml").older()]
    assert len(states) == MAX_OLD
    assert [dump_rig(rig) for rig in states[:3]] == [dump_rig(numbered(k)) for k in range(3)]
    assert [dump_rig(rig) for rig in states[3:]] == moved[-len(states) + 2 : -1]
    assert dump_rig(active.earlier()[0]) == dump_rig(numbered(2))
    makers = [version.unnamed_maker for version in active.history().versions]
    assert makers == ["the server or a file"] * 3 + ["the server"] * (MAX_OLD - 2)


def test_content_decides_which_rig_is_used_and_no_time_of_a_file(tmp_path: Path):
    """Copies, clones and clocks change the times of files. A given rig that the user edited later has precedence."""
    settings = saving(tmp_path)
    given, saved = tmp_path / "rig.yaml", tmp_path / "rig.saved.yaml"
    with serving(settings) as (_, client):
        client.set_rig(FEWER)
    for at in (0, 4 * 10**9):
        os.utime(given, (at, at))
        assert loaded(given, saved) == FEWER
    original = given.read_text()
    given.write_text(dump_rig(numbered(3)))
    os.utime(given, (0, 0))
    assert loaded(given, saved) == numbered(3)
    given.write_text(original)
    assert loaded(given, saved) == FEWER


def test_an_undone_rig_stays_in_force_although_it_was_saved_in_place_of_another_file(tmp_path: Path):
    settings = saving(tmp_path)
    with serving(settings) as (_, client):
        client.set_rig(FEWER)
    (tmp_path / "rig.yaml").write_text(dump_rig(numbered(3)))
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == numbered(3)
        assert client.undo_rig().rig == FEWER
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == FEWER


def test_a_saved_rig_of_an_older_version_is_used_until_the_given_one_is_edited(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    """Its file does not say in place of which content it is used: both are named, and from then on it does."""
    given, saved = tmp_path / "rig.yaml", tmp_path / "rig.saved.yaml"
    config(tmp_path)  # writes rig.yaml
    saved.write_text(dump_rig(FEWER))
    with caplog.at_level(logging.WARNING, "fusion"):
        assert loaded(given, saved) == FEWER
    assert f"using {saved} and not {given}" in caplog.text
    given.write_text(dump_rig(numbered(3)))
    assert loaded(given, saved) == numbered(3)


def test_undo_restores_the_saved_rig_that_an_edited_file_replaced(tmp_path: Path):
    settings = saving(tmp_path)
    of_another = SavedChange(t_ns=0, given="0" * 32).line()
    (tmp_path / "rig.saved.yaml").write_text(of_another + dump_rig(FEWER))
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == GIVEN
        assert client.undo_rig().rig == FEWER
        assert client.redo_rig().rig == GIVEN


@pytest.mark.parametrize(
    "broken", ["cameras: {", "[" * 100, "cameras: {cam0: {time_offset_ms: .nan}}", "\0\xff"]
)
def test_a_broken_saved_rig_does_not_prevent_a_start(
    tmp_path: Path, broken: str, caplog: pytest.LogCaptureFixture
):
    """The one before it is used; without one, the given rig. The log names the file."""
    settings = saving(tmp_path)
    with serving(settings) as (_, client):
        for rig in (FEWER, numbered(1), numbered(2)):
            client.set_rig(rig)
    (tmp_path / "rig.saved.yaml").write_text(broken)
    with caplog.at_level(logging.WARNING, "fusion"), serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == numbered(1)
    assert f"the saved rig {tmp_path / 'rig.saved.yaml'} is not used" in caplog.text
    for path in tmp_path.glob("rig.saved.*yaml"):
        path.write_text(broken)
    with serving(settings) as (_, client):
        assert client.rig(DEADLINE_S) == GIVEN


def test_the_server_of_another_zone_follows_the_rig_and_the_robots_of_the_first(
    tmp_path: Path, endpoint: str
):
    """It starts after the first change."""
    zones = zones_of({"west": ("cam0", "cam1"), "east": ("cam2", "cam3")}, endpoint)
    settings = msgspec.structs.replace(saving(tmp_path), listen=(endpoint,), zones=zones, zone="west")
    with serving(settings) as (leader, client):
        client.set_rig(numbered(1))
        second = msgspec.structs.replace(settings, listen=("tcp/127.0.0.1:0",), zone="east")
        with serving(second) as (follower, _):
            wait_for(lambda: follower.pipeline.active_rig.rig == numbered(1))
            wait_for(lambda: follower.pipeline.robots == leader.pipeline.robots)
            client.change_robots(rename={"a": "b"})
            wait_for(lambda: list(follower.pipeline.robots) == ["b"])
            client.set_rig(FEWER)
            wait_for(lambda: follower.pipeline.active_rig.rig == FEWER)
            client.undo_rig()
            wait_for(lambda: follower.pipeline.active_rig.rig == numbered(1))
            assert client.redo_rig().rig == FEWER, "the other server wrote no files"
            client.session.put(robots_key("test"), encode(Robots(robots={})))
            wait_for(lambda: follower.pipeline.robots == {})
            wait_for(
                lambda: list(follower.pipeline.robots) == ["b"]
            )  # the first server's status tells of them


def test_an_undo_that_arrives_twice_undoes_one_change(tmp_path: Path):
    """As of two operators, or of a request that a broken connection repeats."""
    with serving(saving(tmp_path)) as (_, client):
        client.set_rig(numbered(1))
        seen = client.set_rig(numbered(2)).t_ns
        assert step_rig(client.session, "test", "undo", "test", rig_t_ns=seen).rig == numbered(1)
        with pytest.raises(RequestError, match="nothing was done, because the rig has changed"):
            step_rig(client.session, "test", "undo", "test", rig_t_ns=seen)
        assert client.rig_history().subject("redo") is not None
        assert client.undo_rig().rig == GIVEN


def test_a_viewer_that_missed_a_publication_requests_the_rig(tmp_path: Path):
    """The status tells since when the rig is in force."""
    with serving(config(tmp_path)) as (_, client):
        t_ns = client.set_rig(FEWER).t_ns
        wait_for(lambda: client.status(DEADLINE_S).next().rig_t_ns == t_ns)


def test_without_a_server_a_request_fails(endpoint: str):
    with (
        open_router([endpoint]) as router,
        pytest.raises(
            NetworkError,
            match=r"no server answers on test/rig/set within 0\.2 s; no server answers there: start it",
        ),
    ):
        set_rig(router, "test", GIVEN, "test", timeout_s=0.2)


def test_the_saved_file_is_the_rig_in_force(tmp_path: Path):
    settings = saving(tmp_path)
    with serving(settings) as (_, client):
        client.set_rig(numbered(1))
        client.set_rig(numbered(2))
        assert load_rig(tmp_path / "rig.saved.yaml") == numbered(2)
        client.undo_rig()
        assert load_rig(tmp_path / "rig.saved.yaml") == numbered(1)
    assert [load_rig(p) for p in sorted(tmp_path.glob("rig.saved.[0-9].yaml"))] == [GIVEN]
    assert load_rig(tmp_path / "rig.saved.undone.1.yaml") == numbered(2)
