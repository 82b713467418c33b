# SPDX-License-Identifier: BSD-3-Clause
"""`fusion run` and `fusion replay`: a recording's every instant, by the code that runs live, as `poses.csv`."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from calib.rig.camera import Camera
from calib.rig.recording import RecordingWriter, iterate
from calib.rig.rig import load_rig
from camera_node.config import write_atomically
from camera_node.errors import ConfigError
from camera_node.protocol.messages import Detections, Keys, encode
from camera_node.sources.observations import detect_frames, read_observations
from camera_node.terminal import track
from fusion.model.frames import CalibratedFrame, FrameSet
from fusion.model.limits import Limits
from fusion.model.robots import Robot, load_robots
from fusion.monitoring.extrinsics_monitor import ExtrinsicsCorrection
from fusion.protocol.messages import RobotPose
from fusion.recordings.record import read_recording
from fusion.server.frame_synchronizer import FrameSynchronizer
from fusion.tracking.result import TrackingResult
from fusion.tracking.smoothing import Smoother
from fusion.tracking.tracker import Tracker

COLUMNS = "t_ns,robot,x,y,z,qw,qx,qy,qz,vx,vy,vz,wx,wy,wz,state,n_markers,n_cameras"


@dataclass
class Summary:
    """What a run found."""

    instants: int = 0
    states: Counter[tuple[str, str]] = field(default_factory=Counter)
    used: Counter[str] = field(default_factory=Counter)
    unused: Counter[str] = field(default_factory=Counter)
    squared_px: Counter[str] = field(default_factory=Counter)
    unlabelled: int = 0
    faults: Counter[str] = field(default_factory=Counter)
    moves: list[str] = field(default_factory=list)

    def add(self, fused: TrackingResult) -> None:
        self.instants += 1
        self.states.update((pose.robot, pose.state) for pose in fused.poses)
        self.unlabelled += int((fused.markers.robot_index() < 0).sum())
        for name, use in fused.cameras.items():
            self.used[name] += use.used
            self.unused[name] += use.unused
            self.squared_px[name] += use.squared_px  # pyright: ignore[reportArgumentType] # sums of floats

    def lines(self, robots: Iterable[str]) -> Iterator[str]:
        """What a person wants to know."""
        yield f"{self.instants} instants, {self.unlabelled} markers of no robot"
        for robot in robots:
            shares = {
                s: self.states[robot, s] / max(self.instants, 1) for s in ("tracked", "coasting", "lost")
            }
            yield f"{robot}: " + ", ".join(f"{state} {share:.1%}" for state, share in shares.items())
        for name in sorted(self.used):
            rms = np.sqrt(self.squared_px[name] / self.used[name]) if self.used[name] else np.nan
            yield f"{name}: residual {rms:.2f} px, {self.used[name]} detections used, {self.unused[name]} not"
        for reason, count in sorted(self.faults.items()):
            yield f"skipped: {count} {reason}"
        yield from self.moves


def fuse_recording(
    messages: Iterable[tuple[int, Detections]],
    cameras: dict[str, Camera],
    robots: dict[str, Robot],
    rate_hz: float | None = None,
    limits: Limits | None = None,
    faults: Counter[str] | None = None,
    smooth: bool = False,
    moves: list[str] | None = None,
) -> Iterator[TrackingResult]:
    """Fuse recorded detections, in order of arrival.

    Args:
        messages: detections of all cameras, and when each arrived (ns).
        cameras: the placed ones.
        robots: see `load_robots`.
        rate_hz: of the instants; without it that of the fastest camera.
        limits: see `Limits`.
        faults: counts what is skipped, by its reason.
        smooth: tell of each instant by all of them, at the end.
        moves: takes a line for each camera that was found to be moved.
    """
    limits = limits or Limits()
    tracker = Tracker(cameras, robots, limits)
    smoother = Smoother(tracker.table.names) if smooth else None
    instants = FrameSynchronizer(round(1e9 / rate_hz) if rate_hz else None, round(limits.lateness_ms * 1e6))
    told = Counter() if faults is None else faults
    for instant in _gather(messages, cameras, instants, told):
        fused = tracker.track(instant)
        if smoother is None:
            yield fused
        else:
            smoother.add(fused)
        for move in tracker.check_extrinsics(instant, fused):
            if moves is not None:
                moves.append(_line(move, instant.t_ns))
    if smoother is not None:
        yield from smoother.smooth()


def _line(move: ExtrinsicsCorrection, t_ns: int) -> str:
    """What a person should know of a moved camera."""
    if move.camera is None:
        return f"moved: camera '{move.name}', seen at t_ns {t_ns}; its detections are left out from then on"
    return (
        f"moved: camera '{move.name}' is placed anew at t_ns {t_ns} and used again; the rig file is as it was"
    )


def run(
    *,
    rig: Path,
    robots: Path,
    out: Path,
    frames: Path | None = None,
    observations: Path | None = None,
    rate_hz: float | None = None,
    smooth: bool = False,
) -> int:
    """Robot poses of every instant of a recording.

    Args:
        rig: rig.yaml with the cameras' poses.
        robots: robots.yaml.
        out: poses.csv to write.
        frames: a folder of <camera>/<t_ns>.png or .jpg.
        observations: an observations.csv instead of frames.
        rate_hz: instants a second; without it those of the fastest camera.
        smooth: let each pose be told by the instants after it too.
    """
    if (frames is None) == (observations is None):
        raise ConfigError("give either --frames FOLDER or --observations CSV")
    _check_rate(rate_hz)
    cameras = load_rig(rig).require_placed(rig)
    declared = load_robots(robots)
    messages = _in_order(_read(frames, observations, cameras), cameras)
    summary = Summary()
    fused = fuse_recording(messages, cameras, declared, rate_hz, None, summary.faults, smooth, summary.moves)
    _tell(fused, out, summary, declared)
    return 0


def replay(
    recording: Path,
    /,
    *,
    out: Path,
    rig: Path | None = None,
    robots: Path | None = None,
    rate_hz: float | None = None,
    smooth: bool = False,
) -> int:
    """Fuse a recording (MCAP) anew, by the code that runs live, each message when it arrived.

    Args:
        recording: the MCAP file.
        out: what to write: poses.csv, or .mcap with the same detections and the new poses and markers.
        rig: another rig.yaml than the recorded one.
        robots: another robots.yaml than the recorded one.
        rate_hz: instants a second; without it those of the fastest camera.
        smooth: let each pose be told by the instants after it too.
    """
    _check_rate(rate_hz)
    recorded = read_recording(recording)
    if rig is None and recorded.rig is None:
        raise ConfigError(f"{recording} holds no rig; give --rig rig.yaml")
    if robots is None and not recorded.robots:
        raise ConfigError(f"{recording} holds no robots; give --robots robots.yaml")
    cameras = load_rig(rig).require_placed(rig) if rig else recorded.rig.placed() if recorded.rig else {}
    declared = load_robots(robots) if robots else recorded.robots
    summary = Summary(faults=recorded.faults)
    fused = fuse_recording(
        recorded.detections, cameras, declared, rate_hz, None, summary.faults, smooth, summary.moves
    )
    if out.suffix == ".mcap":
        _copy(recording, out, track(fused, "fusing"), summary)
        print("\n".join([*summary.lines(declared), f"wrote {out}"]))
    else:
        _tell(fused, out, summary, declared)
    return 0


def _check_rate(rate_hz: float | None) -> None:
    if rate_hz is not None and not 0.1 <= rate_hz <= 1000:
        raise ConfigError(f"--rate-hz {rate_hz} is not within 0.1 and 1000")


def _tell(fused: Iterable[TrackingResult], out: Path, summary: Summary, robots: Iterable[str]) -> None:
    """Write poses.csv and say what was found."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS.split(","))
    for instant in track(fused, "fusing"):
        summary.add(instant)
        writer.writerows(map(_row, instant.poses))
    write_atomically(out, text.getvalue())
    print("\n".join([*summary.lines(robots), f"wrote {out}"]))


def _copy(recording: Path, out: Path, fused: Iterable[TrackingResult], summary: Summary) -> None:
    """A recording with the same messages but other poses and markers, which stand at their instants."""
    entries = [e for e in iterate(recording, Counter()) if not e[0].endswith(("/pose", "/markers"))]
    arena = next(key for key, _, _ in entries if key.endswith("/detections")).split("/")[0]
    keys = Keys(arena)
    for instant in fused:
        summary.add(instant)
        entries += [(keys.robot_pose(pose.robot), encode(pose), instant.t_ns) for pose in instant.poses]
        entries.append((keys.markers, encode(instant.markers), instant.t_ns))
    with RecordingWriter(out) as writer:
        for entry in sorted(entries, key=lambda entry: entry[2]):
            writer.put(*entry)


def _read(frames: Path | None, observations: Path | None, cameras: dict[str, Camera]) -> list[Detections]:
    if frames is not None:
        return detect_frames(frames)
    assert observations is not None
    return read_observations(observations, {name: (c.width, c.height) for name, c in cameras.items()})


def _in_order(messages: Iterable[Detections], cameras: dict[str, Camera]) -> list[tuple[int, Detections]]:
    """Messages as if each arrived at its true capture time."""
    offset = {name: round(camera.time_offset_ms * 1e6) for name, camera in cameras.items()}
    arrivals = [(message.t_ns + offset.get(message.camera, 0), message) for message in messages]
    return sorted(arrivals, key=lambda arrival: arrival[0])


def _gather(
    messages: Iterable[tuple[int, Detections]],
    cameras: dict[str, Camera],
    instants: FrameSynchronizer,
    faults: Counter[str],
) -> Iterator[FrameSet]:
    for received_ns, message in messages:
        camera = cameras.get(message.camera)
        if camera is None:
            faults[f"frames of camera '{message.camera}', which the rig does not place"] += 1
        elif (message.width, message.height) != (camera.width, camera.height):
            faults[f"frames of camera '{message.camera}', whose size is not the rig's"] += 1
        else:
            instants.add(CalibratedFrame.of(message, camera))
            yield from instants.take(received_ns)
    for name, late in instants.late.items():
        if late:
            faults[f"frames of camera '{name}' that came too late"] += late
    yield from instants.finish()


def _row(pose: RobotPose) -> list:
    numbers = (*pose.position, *pose.quaternion_wxyz, *pose.velocity, *pose.angular_velocity)
    return [
        pose.t_ns,
        pose.robot,
        *(f"{x:.7g}" for x in numbers),
        pose.state,
        pose.n_markers,
        len(pose.cameras),
    ]
