# SPDX-License-Identifier: BSD-3-Clause
"""Simulates wand recordings of cheap cameras: free-running, with clock offsets and drifts, noise, outliers and gaps.

The simulation makes detections, not images, and works on columns: a minute of sixteen cameras takes seconds. The wand
is printed on one side, so that opposite cameras never see it at once.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose, invert, look_at
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import WAND, outlines, with_sizes

EPOCH_S = 1_000.0


@dataclass(frozen=True, kw_only=True)
class WandScenario:
    """Settings of a simulated recording.

    Attributes:
        offset_ms, drift_ppm: ranges of the clocks' offsets and of their rates.
        sized: whether detections have axes; without, their centres are those of the discs, not of the ellipses.
        arc: part of the ring on which cameras stand.
        both_sides: whether the wand is visible from behind.
        rolling_ms: duration of the rolling shutter's readout.
        jitter_ms: standard deviation of the timestamps.
    """

    cameras: int = 8
    seconds: float = 60.0
    rate_hz: float = 60.0
    sigma_px: float = 0.1
    outliers: float = 0.05
    missing: float = 0.10
    offset_ms: float = 150.0
    drift_ppm: float = 50.0
    free_running: bool = True
    numbered: bool = False
    sized: bool = True
    speed: float = 1.0
    radius_m: float = 3.2
    arc: float = 1.0
    both_sides: bool = False
    rolling_ms: float = 0.0
    jitter_ms: float = 0.0
    wand: Body = field(default_factory=lambda: WAND)
    seed: int = 0


@dataclass(frozen=True)
class SimulatedRecording:
    """A recording and its truth: the rig, with time offsets in the middle of the recording, and the clocks' drift by
    camera, ppm; true time = timestamp + offset + drift (timestamp - middle)."""

    truth: Rig
    drift_ppm: dict[str, float]
    messages: list[Detections]

    @property
    def intrinsics(self) -> Rig:
        """The rig before a wand calibration."""
        bare = {
            n: msgspec.structs.replace(c, T_world_cam=None, time_offset_ms=0.0)
            for n, c in self.truth.cameras.items()
        }
        return Rig(cameras=bare)


class WandPath:
    """The path of the wand: sums of sines of up to 1.3 Hz in each coordinate, and a slow rotation."""

    def __init__(self, seed: int, speed: float) -> None:
        rng = np.random.default_rng([7, seed])
        self.rate = 2 * np.pi * speed * rng.uniform([[0.05], [0.25], [0.8]], [[0.12], [0.6], [1.3]], (3, 6))
        self.phase = rng.uniform(0, 2 * np.pi, (3, 6))
        self.reach = np.array([[0.7, 0.7, 0.3, 0.3, 0.3, 0.5], [0.3, 0.3, 0.25, 0.3, 0.25, 0.7]])
        self.reach = np.vstack([self.reach, [0.06, 0.06, 0.05, 0.15, 0.1, 0.3]])
        self.turn = 2 * np.pi * speed / 20

    def pose(self, t_s: Array) -> tuple[Array, Array]:
        """Return rotations (n, 3, 3) and positions (n, 3) of the wand; its printed side faces outwards."""
        waves = (self.reach * np.sin(self.rate * t_s[:, None, None] + self.phase)).sum(axis=1)
        place = waves[:, :3] + [0.0, 0.0, 1.2]
        facing, nod, roll = self.turn * t_s + waves[:, 3], 0.3 + 0.7 * waves[:, 4], waves[:, 5]
        z = np.column_stack([np.cos(facing) * np.cos(nod), np.sin(facing) * np.cos(nod), np.sin(nod)])
        level = np.column_stack([-np.sin(facing), np.cos(facing), 0 * facing])
        steep = np.cross(z, level)
        x = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * steep
        return np.stack([x, np.cross(z, x), z], axis=-1), place


def place_cameras(scenario: WandScenario, rng: np.random.Generator) -> Rig:
    """Return cameras of 1280 x 800 pixels on a ring, with distorted lenses and clock offsets, that look inwards."""
    cameras = {}
    for k in range(scenario.cameras):
        turn = 2 * np.pi * scenario.arc * (k + 0.3 * rng.uniform(-1, 1)) / scenario.cameras
        at = [scenario.radius_m * np.cos(turn), scenario.radius_m * np.sin(turn), rng.uniform(2.2, 2.9)]
        focal = rng.uniform(760, 900)
        cameras[f"cam{k:02}"] = Camera(
            width=1280,
            height=800,
            fx=focal,
            fy=focal * rng.uniform(0.998, 1.002),
            cx=640 + rng.uniform(-15, 15),
            cy=400 + rng.uniform(-15, 15),
            distortion=(-0.1, 0.03, 0.0002, -0.0001, 0.0),
            T_world_cam=Pose.from_matrix(look_at(np.array(at), np.append(rng.uniform(-0.2, 0.2, 2), 1.1))),
            time_offset_ms=rng.uniform(-0.5, 0.5) * scenario.offset_ms,
        )
    return Rig(cameras=cameras)


def record(scenario: WandScenario) -> SimulatedRecording:
    """Simulate a recording."""
    rng = np.random.default_rng(scenario.seed)
    truth, path = place_cameras(scenario, rng), WandPath(scenario.seed, scenario.speed)
    drift = {name: rng.uniform(-0.5, 0.5) * scenario.drift_ppm for name in truth.cameras}
    messages: list[Detections] = []
    for name, camera in truth.cameras.items():
        phase = rng.uniform() / scenario.rate_hz if scenario.free_running else 0.0
        t_s = np.arange(int(scenario.seconds * scenario.rate_hz)) / scenario.rate_hz + phase
        rate = 1 + drift[name] * 1e-6
        stamp_s = scenario.seconds / 2 + (t_s - scenario.seconds / 2 - camera.time_offset_ms * 1e-3) / rate
        stamp_s = stamp_s + 1e-3 * scenario.jitter_ms * rng.standard_normal(len(t_s))
        header = {"camera": name, "width": camera.width, "height": camera.height}
        for k, roundels in enumerate(_detect(camera, scenario, path, t_s, rng)):
            t_ns = round((EPOCH_S + stamp_s[k]) * 1e9)
            messages.append(Detections.pack(roundels, seq=k, t_ns=t_ns, **header))
    return SimulatedRecording(
        truth, drift, sorted(messages, key=lambda message: (message.t_ns, message.camera))
    )


def _detect(
    camera: Camera, scenario: WandScenario, path: WandPath, t_s: Array, rng: np.random.Generator
) -> list[Roundels]:
    """Return the detections of a camera in its frames at times (n,)."""
    count = len(scenario.wand.markers)
    points, normal = _place(camera, scenario, path, np.repeat(t_s, count))
    if scenario.rolling_ms:
        row = np.nan_to_num(camera.project(points)[:, 1] / camera.height - 0.5)
        points, normal = _place(
            camera, scenario, path, np.repeat(t_s, count) + 1e-3 * scenario.rolling_ms * row
        )
    uv, axes, angle = outlines(camera, points, normal, scenario.wand.diameter_m / 2)
    cosine = -(points * normal).sum(axis=1) / np.linalg.norm(points, axis=1)
    cosine = np.abs(cosine) if scenario.both_sides else cosine
    inside = ((uv > 20) & (uv < [camera.width - 20, camera.height - 20])).all(axis=1)
    seen = inside & (cosine > 0.3 * scenario.sized) & (rng.random(len(uv)) >= scenario.missing)
    if not scenario.sized:
        uv = camera.project(points)
    uv = uv + scenario.sigma_px * rng.standard_normal(uv.shape)
    axes = axes + 2 * scenario.sigma_px * rng.standard_normal(axes.shape)
    gross = rng.random(len(uv)) < scenario.outliers
    uv[gross] += rng.uniform(-60, 60, (int(gross.sum()), 2))
    frames = []
    for rows in np.arange(len(uv)).reshape(-1, count):
        rows = rng.permutation(rows[seen[rows]])
        numbers = (rows % count).astype(np.int32) if scenario.numbered else None
        roundels = Roundels.from_points(uv[rows], max(scenario.sigma_px, 0.02), numbers)
        if scenario.sized:
            full_axes = np.sort(axes[rows], axis=1)[:, ::-1]
            roundels = with_sizes(roundels, full_axes, angle[rows])
        frames.append(roundels)
    return frames


def _place(camera: Camera, scenario: WandScenario, path: WandPath, t_s: Array) -> tuple[Array, Array]:
    """Return markers (n, 3) at their times (n,), and their normals (n, 3), camera frame."""
    R, place = path.pose(t_s)
    local = np.tile(scenario.wand.points, (len(t_s) // len(scenario.wand.markers), 1))
    T = invert(camera.matrix())
    world = np.einsum("nij,nj->ni", R, local) + place
    return world @ T[:3, :3].T + T[:3, 3], R[:, :, 2] @ T[:3, :3].T


def with_clocks(
    messages: Sequence[Detections], middle_ns: int, clocks: Mapping[str, tuple[float, float]]
) -> list[Detections]:
    """The messages with stamps that are later by an offset, s, at a time of the truth, and grow faster by a rate."""

    def stamp(m: Detections) -> int:
        offset_s, rate = clocks.get(m.camera, (0.0, 0.0))
        return round(middle_ns + (m.t_ns - middle_ns) * (1 + rate) + 1e9 * offset_s)

    return [msgspec.structs.replace(m, t_ns=stamp(m)) for m in messages]
