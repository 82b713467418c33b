# SPDX-License-Identifier: BSD-3-Clause
"""Recordings: reading returns what was written, a replay repeats the poses, smoothing uses later frames."""

import csv
import threading
from functools import partial
from importlib.metadata import version
from itertools import chain, count
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh

from calib.rig.recording import RecordingWriter, read_messages
from calib.rig.rig import Rig
from calib.rig.rig_messages import RigMessage
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.pose import rotation_from_vector
from camera_node.protocol.messages import encode
from camera_node.protocol.server_connection import Connection, ServerConnection
from fusion.commands.record import record
from fusion.commands.replay import replay
from fusion.commands.trim import trim
from fusion.model.frames import FrameSet
from fusion.model.robots import MOTIONS
from fusion.protocol.pose_messages import Robots
from fusion.recordings import arena_recording
from fusion.recordings.arena_recording import DETECTIONS, NO_ROBOTS, POSE, ArenaRecorder, read_recording
from fusion.recordings.offline_fusion import OfflineArena, Summary, fuse_recording
from fusion.tracking.result import NO_SOLUTION, TrackingResult
from fusion.tracking.smoothing import Smoother
from fusion.tracking.tracker import Tracker
from tests.fusion.serving import ARENA, KEYS, config, live, send, serving
from tests.fusion.synthetic import TRIANGLE, Arena, Motion, line, precise
from tests.fusion.tracks import errors, poses_of
from tests.processes import run_program
from tests.waiting import DEADLINE_S, in_thread, repeating, wait_for

BUSY_S = 3.5  # more than 3 s, after which the recorder gave up before, with answers of up to 1 s
MOVING = Arena(
    {"a": TRIANGLE}, {"a": line((0.2, -0.3, 0.4), (0.9, 0.6, 0.1), turn=(0.2, 0.1, 1.0))}, sigma_px=0.1
)


def write(path: Path, arena: Arena, n: int = 20) -> list:
    """A recording in which every frame arrives 20 ms after its exposure; the arrivals."""
    messages = sorted(arena.messages(n), key=lambda message: message.t_ns)
    arrivals = [(message.t_ns + 20_000_000, message) for message in messages]
    with RecordingWriter(path) as writer:
        writer.put(
            "x/rig", encode(RigMessage(t_ns=arrivals[0][0], rig=Rig(cameras=arena.cameras))), arrivals[0][0]
        )
        writer.put("x/robots", encode(Robots(robots=arena.robots)), arrivals[0][0])
        for received_ns, message in arrivals:
            writer.put(f"x/camera/{message.camera}/detections", encode(message), received_ns)
    return arrivals


def test_a_replay_repeats_the_poses(tmp_path):
    """Byte for byte: from the messages, from their recording, and from the recording that the replay writes."""
    arrivals = write(tmp_path / "in.mcap", MOVING)
    expected = [
        pose
        for f in fuse_recording(arrivals, OfflineArena(MOVING.cameras, MOVING.robots))
        for pose in f.poses
    ]
    assert len(expected) > 10
    for source, out in (("in.mcap", "once.mcap"), ("once.mcap", "twice.mcap")):
        assert replay(tmp_path / source, out=tmp_path / out) == 0
        poses = [encode(pose) for _, pose in read_recording(tmp_path / out).messages(POSE)]
        assert poses == list(map(encode, expected))
    replay(tmp_path / "in.mcap", out=tmp_path / "poses.csv")
    with (tmp_path / "poses.csv").open() as file:
        assert [int(row["t_ns"]) for row in csv.DictReader(file)] == [pose.t_ns for pose in expected]


def test_a_replay_goes_on_after_a_frame_set_without_a_solution(monkeypatch: pytest.MonkeyPatch):
    """As the server goes on; the replay ended with the exception."""
    track, numbers = Tracker.track, count()

    def without_a_covariance_once(self: Tracker, frame_set: FrameSet) -> TrackingResult:
        if next(numbers) == 10:
            self.table.states.P.fill(np.nan)
        return track(self, frame_set)

    monkeypatch.setattr(Tracker, "track", without_a_covariance_once)
    messages, summary = sorted(MOVING.messages(30), key=lambda m: m.t_ns), Summary()
    arena = OfflineArena(MOVING.cameras, MOVING.robots)
    results = [*fuse_recording([(m.t_ns + 20_000_000, m) for m in messages], arena, summary)]
    assert summary.faults[NO_SOLUTION] == 1
    assert [pose.state for pose in results[-1].poses] == ["tracked"]


def test_robots_that_are_declared_after_the_start_are_recorded(tmp_path, caplog: pytest.LogCaptureFixture):
    """Without any, the recorder says at its start what is missing; with them, a replay needs no file of robots."""
    path, stop = tmp_path / "later.mcap", threading.Event()
    with serving(config(tmp_path)) as (server, client), RecordingWriter(path) as writer:
        client.change_robots(remove=("a",))
        recorder = ArenaRecorder(client.connection, "test", writer)
        with in_thread(partial(recorder.run, stop), stop.set):
            wait_for(lambda: recorder.robots == frozenset())
            wait_for(lambda: NO_ROBOTS in caplog.text)
            client.change_robots(define={"late": TRIANGLE})
            wait_for(lambda: recorder.robots == {"late"})
            send(server, live(ARENA.messages(10)))
            wait_for(lambda: writer.counts.get(KEYS.detections("cam0"), 0) == 10)
    assert read_recording(path).robots == {"late": TRIANGLE}
    assert replay(path, out=tmp_path / "fused.mcap") == 0


def test_a_forged_status_does_not_keep_the_recorder_from_ending(tmp_path, monkeypatch: pytest.MonkeyPatch):
    """It names robots that no server declares, and the server does not answer: the recorder waited ten seconds."""
    monkeypatch.setattr(arena_recording, "ANSWER_S", 100 * DEADLINE_S)
    stop, busy, release, path = threading.Event(), threading.Event(), threading.Event(), tmp_path / "x.mcap"
    with serving(config(tmp_path)) as (server, client), RecordingWriter(path) as writer:
        recorder = ArenaRecorder(client.connection, "test", writer)
        thread = threading.Thread(target=recorder.run, args=(stop,), daemon=True)
        thread.start()
        wait_for(lambda: recorder.robots == ARENA.robots.keys())
        status = client.status(DEADLINE_S).next()
        server.transport.enqueue(lambda: busy.set() or release.wait(2 * DEADLINE_S))
        assert busy.wait(DEADLINE_S)
        before = writer.counts[KEYS.fusion_status]
        forged = msgspec.structs.replace(status, robots={"forged": "tracked"})
        client.session.put(KEYS.fusion_status, encode(forged))
        wait_for(lambda: writer.counts[KEYS.fusion_status] > before)
        stop.set()
        thread.join(DEADLINE_S)
        has_ended = not thread.is_alive()
        release.set()
    assert has_ended


@pytest.mark.parametrize("is_link", [False, True])
def test_a_replay_does_not_overwrite_its_recording(tmp_path, is_link: bool):
    write(tmp_path / "in.mcap", MOVING, 3)
    content, out = (tmp_path / "in.mcap").read_bytes(), tmp_path / ("link.mcap" if is_link else "in.mcap")
    if is_link:
        out.symlink_to(tmp_path / "in.mcap")
    with pytest.raises(ConfigError, match="is the recording itself"):
        replay(tmp_path / "in.mcap", out=out)
    assert (tmp_path / "in.mcap").read_bytes() == content


def test_a_truncated_recording_is_read_up_to_its_end(tmp_path):
    write(tmp_path / "whole.mcap", MOVING, 200)
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "half.mcap").write_bytes(data[: len(data) * 9 // 10])
    whole, part = (read_recording(tmp_path / f"{name}.mcap") for name in ("whole", "half"))
    assert part.robots == whole.robots == MOVING.robots
    assert 0 < part.counts[DETECTIONS] <= whole.counts[DETECTIONS]
    assert sum(part.faults.values()) == 1


@pytest.mark.parametrize("content", [None, b"", b"no MCAP at all"])
def test_files_that_are_no_recordings_are_refused(tmp_path, content):
    if content is not None:
        (tmp_path / "x.mcap").write_bytes(content)
    with pytest.raises(ConfigError, match=r"x\.mcap"):
        read_recording(tmp_path / "x.mcap")


def test_a_live_arena_is_recorded_with_its_rig_and_robots(tmp_path, capsys):
    with serving(config(tmp_path)) as (server, client):

        def publish() -> None:
            send(server, live(ARENA.messages(3)))
            client.status(60.0).next()

        with repeating(publish):
            connection = Connection(connect=server.endpoints, arena="test")
            record(tmp_path / "live.mcap", connection=connection, seconds=4.0)
    recording = read_recording(tmp_path / "live.mcap")
    assert {message.camera for _, message in recording.messages(DETECTIONS)} == ARENA.cameras.keys()
    assert recording.rig is not None
    assert recording.rig.cameras == ARENA.cameras
    assert recording.robots == server.pipeline.robots
    assert f"on {KEYS.detections('cam0')}" in capsys.readouterr().out


@pytest.mark.ci
def test_a_public_recording_has_pictures_and_versions(tmp_path):
    """Of the first camera, as it sends them; a part of the recording keeps them, and the benchmark reads it."""
    path, part, jpeg = tmp_path / "public.mcap", tmp_path / "part.mcap", b"\xff\xd8 as the camera sends it"
    with serving(config(tmp_path)) as (server, client):

        def answer(query: zenoh.Query) -> None:
            query.reply(query.key_expr, jpeg)

        session = client.connection.session(DEADLINE_S)
        camera = session.declare_queryable(KEYS.snapshot("cam0"), answer)
        stop = threading.Event()
        with RecordingWriter(path) as writer:
            recorder = ArenaRecorder(client.connection, "test", writer, is_public=True)
            with in_thread(partial(recorder.run, stop), stop.set):
                wait_for(
                    lambda: writer.counts[KEYS.snapshot("cam0")] >= 2,
                    lambda: send(server, live(ARENA.messages(3))),
                )
        camera.undeclare()
    assert trim(path, part, from_s=0.5) == 0
    for file in (path, part):
        recording = read_recording(file)
        assert recording.installation is not None
        assert recording.installation.packages["roundel"] == version("roundel")
        assert {data for key, data, _ in read_messages(file) if key == KEYS.snapshot("cam0")} == {jpeg}
        assert not recording.faults


def test_a_short_recording_of_a_busy_server_holds_its_rig_and_robots(tmp_path):
    """The server answers the request for its robots only after the recording was ended: that waits for the answer."""
    stop, busy, release = threading.Event(), threading.Event(), threading.Event()
    path = tmp_path / "live.mcap"
    with (
        serving(config(tmp_path)) as (server, _),
        ServerConnection(server.endpoints) as connection,
        RecordingWriter(path) as writer,
    ):
        server.transport.enqueue(lambda: busy.set() or release.wait(DEADLINE_S))
        assert busy.wait(DEADLINE_S)
        recorder = threading.Thread(target=ArenaRecorder(connection, "test", writer).run, args=[stop])
        recorder.start()
        wait_for(
            lambda: writer.counts[KEYS.detections("cam0")], lambda: send(server, live(ARENA.messages(3)))
        )
        stop.set()
        threading.Timer(BUSY_S, release.set).start()
        recorder.join(DEADLINE_S)
        robots = server.pipeline.robots
    recording = read_recording(path)
    assert recording.robots == robots
    assert recording.rig is not None


def test_a_recording_rotates_by_time_in_a_fresh_process(tmp_path):
    """Every file holds the rig and the robots, so it replays by itself; together they hold all seconds."""
    with serving(config(tmp_path)) as (server, client):

        def publish() -> None:
            send(server, live(ARENA.messages(3)))
            client.status(60.0).next()

        with repeating(publish):
            words = (
                "--rotate-minutes",
                "0.03",
                "--seconds",
                "6",
                "--arena",
                "test",
                "--connect",
                *server.endpoints,
            )
            recorded = run_program("fusion", "record", str(tmp_path / "live.mcap"), *words)
    assert recorded.returncode == 0, recorded.stderr
    files = sorted(tmp_path.glob("live-*.mcap"))
    assert 3 <= len(files) <= 5
    for file in files[1:-1]:
        recording = read_recording(file)
        assert recording.rig is not None
        assert recording.rig.cameras == ARENA.cameras
        assert recording.robots == ARENA.robots


def smoothed(arena: Arena, smooth: bool, n: int = 18) -> list[TrackingResult]:
    arrivals = [(message.t_ns, message) for message in arena.messages(n)]
    arrivals.sort(key=lambda arrival: arrival[0])
    return list(fuse_recording(arrivals, OfflineArena(precise(arena.cameras), arena.robots, smooth=smooth)))


def driven(seed: int) -> Motion:
    """A motion for two seconds by white noise on acceleration, as `ground` declares it."""
    rng, step_s, n = np.random.default_rng(seed), 1e-3, 2000
    noise = (
        rng.normal(size=(2, n, 3)) * np.sqrt(np.array(MOTIONS["ground"].densities) * step_s)[:, None, None]
    )
    omega, v = np.cumsum(noise, axis=1) + np.array([[0.2, 0.1, 1.0], [0.9, 0.6, 0.1]])[:, None]
    p = np.array([0.2, -0.3, 0.4]) + np.cumsum(v, axis=0) * step_s
    R = [np.eye(3)]
    for turn in omega[:-1] * step_s:
        R.append(rotation_from_vector(turn) @ R[-1])

    def at(t_s: float) -> tuple[np.ndarray, np.ndarray]:
        k = int(np.clip(t_s / step_s, 0, n - 1))
        later_s = t_s - k * step_s
        return rotation_from_vector(omega[k] * later_s) @ R[k], p[k] + v[k] * later_s

    return at


@pytest.mark.ci
@pytest.mark.computed
def test_smoothing_is_more_accurate():
    """Velocities improve most if the cameras are synchronous, because the filter then has them from the past only."""
    robots, rms = {"a": msgspec.structs.replace(TRIANGLE, motion="ground")}, {}
    for smooth in (True, False):
        squares = []
        for seed in range(8):
            arena = Arena(robots, MOVING.motions, phases=(0.0,) * 4, sigma_px=0.1, seed=seed)
            pose = poses_of(smoothed(arena, smooth), "a")[9]
            p = [arena.truth("a", pose.t_ns + dt)[1] for dt in (0, 10**6)]
            squares.append(np.sum((pose.velocity - (p[1] - p[0]) / 1e-3) ** 2))
        rms[smooth] = np.sqrt(np.mean(squares))
    assert rms[True] < 0.8 * rms[False]


@pytest.mark.ci
@pytest.mark.computed
def test_the_covariance_of_smoothed_poses_is_consistent():
    """The squared Mahalanobis errors of pose in the middle of 8 runs: chi-square with 6 degrees, mean 6 +- 4 sqrt(12 /
    8)."""
    robots, squares = {"a": msgspec.structs.replace(TRIANGLE, motion="ground")}, []
    for seed in range(8):
        arena = Arena(robots, {"a": driven(seed)}, phases=(0.0,) * 4, sigma_px=0.1, seed=seed)
        pose = poses_of(smoothed(arena, smooth=True), "a")[9]
        e, P = errors(arena, [pose])[0], pose.covariance_matrix[:6, :6]
        squares.append(e @ np.linalg.solve(P, e))
    assert np.mean(squares) == pytest.approx(6, abs=4 * np.sqrt(12 / 8))


def test_smoothing_preserves_frame_sets_and_states():
    arena = Arena(MOVING.robots, MOVING.motions, sigma_px=0.1, hidden=lambda robot, marker, t: 0.3 < t < 0.75)
    plain, better = smoothed(arena, False, 30), smoothed(arena, True, 30)
    assert [f.t_ns for f in plain] == [f.t_ns for f in better]
    assert [[p.state for p in f.poses] for f in plain] == [[p.state for p in f.poses] for f in better]


@pytest.mark.ci
def test_a_long_recording_is_smoothed_in_parts_as_if_it_were_whole():
    """What frame sets later than the lag change is below a thousandth of a standard deviation."""
    arena = Arena(MOVING.robots, MOVING.motions, sigma_px=0.1, hidden=lambda robot, marker, t: 0.9 < t < 1.1)
    results, names = smoothed(arena, False, 120), tuple(arena.robots)
    seconds = 1e-9 * (results[-1].t_ns - results[0].t_ns)
    parts, whole = Smoother(names), Smoother(names, lag_ns=round(1e12))
    in_parts = [[*parts.add(result)] for result in results]
    assert sum(map(len, in_parts)) >= len(results) * (1 - 2 / seconds)  # no more than twice the lag is held
    assert not any(whole.add(result) for result in results)
    both = zip([*chain(*in_parts), *parts.finish()], whole.finish(), strict=True)
    for part, reference in both:
        for a, b in zip(part.poses, reference.poses, strict=True):
            sigma = np.sqrt(np.diag(b.covariance_matrix)[3:6])
            assert np.abs(np.subtract(a.position, b.position)) == pytest.approx(0, abs=1e-3 * sigma.min())
