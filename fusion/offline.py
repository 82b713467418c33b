# SPDX-License-Identifier: BSD-3-Clause
"""`fusion run`: a recording's every instant, by the code that runs live, as `poses.csv`."""

import csv
import io
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.progress import track

from calib.camera import Camera
from calib.rig import load_rig
from camera_node.config import write_atomically
from camera_node.errors import ConfigError
from camera_node.messages import Detections
from camera_node.observations import detect_frames, read_observations
from fusion.instants import Frame, Instant, Instants
from fusion.messages import RobotPose
from fusion.report import Fused
from fusion.robots import Robot, load_robots
from fusion.tracker import Limits, Tracker

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

    def add(self, fused: Fused) -> None:
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


def fuse_recording(
    messages: Iterable[Detections],
    cameras: dict[str, Camera],
    robots: dict[str, Robot],
    rate_hz: float | None = None,
    limits: Limits | None = None,
    faults: Counter[str] | None = None,
) -> Iterator[Fused]:
    """Fuse recorded detections, in order of time.

    Args:
        messages: detections of all cameras, in any order.
        cameras: the placed ones.
        robots: see `load_robots`.
        rate_hz: of the instants; without it that of the fastest camera.
        limits: see `Limits`.
        faults: counts what is skipped, by its reason.
    """
    limits = limits or Limits()
    tracker = Tracker(cameras, robots, limits)
    period_ns = round(1e9 / rate_hz) if rate_hz else None
    for instant in _gather(messages, cameras, Instants(period_ns, round(limits.lateness_ms * 1e6)), faults):
        yield tracker.fuse(instant)


def run(
    *,
    rig: Path,
    robots: Path,
    out: Path,
    frames: Path | None = None,
    observations: Path | None = None,
    rate_hz: float | None = None,
) -> int:
    """Robot poses of every instant of a recording.

    Args:
        rig: rig.yaml with the cameras' poses.
        robots: robots.yaml.
        out: poses.csv to write.
        frames: a folder of <camera>/<t_ns>.png or .jpg.
        observations: an observations.csv instead of frames.
        rate_hz: instants a second; without it those of the fastest camera.
    """
    if (frames is None) == (observations is None):
        raise ConfigError("give either --frames FOLDER or --observations CSV")
    if rate_hz is not None and not 0.1 <= rate_hz <= 1000:
        raise ConfigError(f"--rate-hz {rate_hz} is not within 0.1 and 1000")
    cameras = load_rig(rig).require_placed(rig)
    declared = load_robots(robots)
    messages = _read(frames, observations, cameras)
    summary = Summary()
    fused = fuse_recording(messages, cameras, declared, rate_hz, faults=summary.faults)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS.split(","))
    for instant in track(fused, "fusing", transient=True):
        summary.add(instant)
        writer.writerows(map(_row, instant.poses))
    write_atomically(out, text.getvalue())
    print("\n".join([*summary.lines(declared), f"wrote {out}"]))
    return 0


def _read(frames: Path | None, observations: Path | None, cameras: dict[str, Camera]) -> list[Detections]:
    if frames is not None:
        return detect_frames(frames)
    assert observations is not None
    return read_observations(observations, {name: (c.width, c.height) for name, c in cameras.items()})


def _gather(
    messages: Iterable[Detections],
    cameras: dict[str, Camera],
    instants: Instants,
    faults: Counter[str] | None,
) -> Iterator[Instant]:
    faults = Counter() if faults is None else faults
    frames = []
    for message in messages:
        camera = cameras.get(message.camera)
        if camera is None:
            faults[f"frames of camera '{message.camera}', which the rig does not place"] += 1
        elif (message.width, message.height) != (camera.width, camera.height):
            faults[f"frames of camera '{message.camera}', whose size is not the rig's"] += 1
        else:
            frames.append(Frame.of(message, camera))
    for frame in sorted(frames, key=lambda frame: frame.t_ns):
        instants.add(frame)
        yield from instants.take(frame.t_ns)
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
