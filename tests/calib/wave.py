# SPDX-License-Identifier: BSD-3-Clause
"""A wave as cheap cameras record it: many cameras at 60 Hz, phases anywhere, clocks apart, noise, mistakes and gaps.

At the level of detections and all in columns, so that a minute of sixteen cameras takes seconds to make. The wand is
printed on one side: a camera sees it only from before it, so that opposite cameras never see it at once.
"""

from dataclasses import dataclass, field

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.arrays import Array
from camera_node.detection.roundels import Roundels
from camera_node.geometry.body import Body
from camera_node.geometry.pose import Pose, invert, look_at
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import WAND, outlines

EPOCH_S = 1_000.0


@dataclass(frozen=True, kw_only=True)
class Wave:
    """What is recorded. `offset_ms` bounds the clocks' differences, `drift_ppm` their rates'; without sizes, centres
    are the discs' own, not their ellipses'. Cameras stand on an `arc` of the ring, see the wand from behind too if it
    has `both_sides`, expose their rows one after the other over `rolling_ms`, and stamps jitter by `jitter_ms`."""

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
class Recorded:
    """A recording and what is true of it: the rig, whose cameras carry their time offset in the middle of the wave,
    and the clocks' drift by camera, ppm; true time = stamp + offset + drift (stamp - middle)."""

    truth: Rig
    drift_ppm: dict[str, float]
    messages: list[Detections]

    @property
    def intrinsics(self) -> Rig:
        """The rig as a calibration starts."""
        bare = {
            n: msgspec.structs.replace(c, T_world_cam=None, time_offset_ms=0.0)
            for n, c in self.truth.cameras.items()
        }
        return Rig(cameras=bare)


class Hand:
    """A waving hand: each coordinate a sum of sines of up to 1.3 Hz, and a slow walk around the arena's middle."""

    def __init__(self, seed: int, speed: float) -> None:
        rng = np.random.default_rng([7, seed])
        self.rate = 2 * np.pi * speed * rng.uniform([[0.05], [0.25], [0.8]], [[0.12], [0.6], [1.3]], (3, 6))
        self.phase = rng.uniform(0, 2 * np.pi, (3, 6))
        self.reach = np.array([[0.7, 0.7, 0.3, 0.3, 0.3, 0.5], [0.3, 0.3, 0.25, 0.3, 0.25, 0.7]])
        self.reach = np.vstack([self.reach, [0.06, 0.06, 0.05, 0.15, 0.1, 0.3]])
        self.turn = 2 * np.pi * speed / 20

    def pose(self, t_s: Array) -> tuple[Array, Array]:
        """Rotations (n, 3, 3) and positions (n, 3) of the wand at times (n,): its printed side looks outwards, to one
        side of the arena after the other."""
        waves = (self.reach * np.sin(self.rate * t_s[:, None, None] + self.phase)).sum(axis=1)
        place = waves[:, :3] + [0.0, 0.0, 1.2]
        facing, nod, roll = self.turn * t_s + waves[:, 3], 0.3 + 0.7 * waves[:, 4], waves[:, 5]
        z = np.column_stack([np.cos(facing) * np.cos(nod), np.sin(facing) * np.cos(nod), np.sin(nod)])
        level = np.column_stack([-np.sin(facing), np.cos(facing), 0 * facing])
        steep = np.cross(z, level)
        x = np.cos(roll)[:, None] * level + np.sin(roll)[:, None] * steep
        return np.stack([x, np.cross(z, x), z], axis=-1), place


def surround(wave: Wave, rng: np.random.Generator) -> Rig:
    """Cameras of 1280 x 800 on a ring, looking inwards, with distorted lenses and clocks apart."""
    cameras = {}
    for k in range(wave.cameras):
        turn = 2 * np.pi * wave.arc * (k + 0.3 * rng.uniform(-1, 1)) / wave.cameras
        at = [wave.radius_m * np.cos(turn), wave.radius_m * np.sin(turn), rng.uniform(2.2, 2.9)]
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
            time_offset_ms=rng.uniform(-0.5, 0.5) * wave.offset_ms,
        )
    return Rig(cameras=cameras)


def record(wave: Wave) -> Recorded:
    """Wave before the cameras."""
    rng = np.random.default_rng(wave.seed)
    truth, hand = surround(wave, rng), Hand(wave.seed, wave.speed)
    drift = {name: rng.uniform(-0.5, 0.5) * wave.drift_ppm for name in truth.cameras}
    messages: list[Detections] = []
    for name, camera in truth.cameras.items():
        phase = rng.uniform() / wave.rate_hz if wave.free_running else 0.0
        t_s = np.arange(int(wave.seconds * wave.rate_hz)) / wave.rate_hz + phase
        rate = 1 + drift[name] * 1e-6
        stamp_s = wave.seconds / 2 + (t_s - wave.seconds / 2 - camera.time_offset_ms * 1e-3) / rate
        stamp_s = stamp_s + 1e-3 * wave.jitter_ms * rng.standard_normal(len(t_s))
        messages += _film(name, camera, wave, hand, t_s, stamp_s, rng)
    return Recorded(truth, drift, sorted(messages, key=lambda message: (message.t_ns, message.camera)))


def _film(
    name: str, camera: Camera, wave: Wave, hand: Hand, t_s: Array, stamp_s: Array, rng: np.random.Generator
) -> list[Detections]:
    count = len(wave.wand.markers)
    points, normal = _place(camera, wave, hand, np.repeat(t_s, count))
    if wave.rolling_ms:
        row = np.nan_to_num(camera.project(points)[:, 1] / camera.height - 0.5)
        points, normal = _place(camera, wave, hand, np.repeat(t_s, count) + 1e-3 * wave.rolling_ms * row)
    uv, axes, angle = outlines(camera, points, normal, wave.wand.diameter_m / 2)
    cosine = -(points * normal).sum(axis=1) / np.linalg.norm(points, axis=1)
    cosine = np.abs(cosine) if wave.both_sides else cosine
    inside = ((uv > 20) & (uv < [camera.width - 20, camera.height - 20])).all(axis=1)
    seen = inside & (cosine > 0.3 * wave.sized) & (rng.random(len(uv)) >= wave.missing)
    if not wave.sized:
        uv = camera.project(points)
    uv = uv + wave.sigma_px * rng.standard_normal(uv.shape)
    axes = axes + 2 * wave.sigma_px * rng.standard_normal(axes.shape)
    gross = rng.random(len(uv)) < wave.outliers
    uv[gross] += rng.uniform(-60, 60, (int(gross.sum()), 2))
    messages = []
    for k, rows in enumerate(np.arange(len(uv)).reshape(-1, count)):
        rows = rng.permutation(rows[seen[rows]])
        numbers = (rows % count).astype(np.int32) if wave.numbered else None
        columns = Roundels.from_points(uv[rows], max(wave.sigma_px, 0.02), numbers)
        if wave.sized:
            columns = _with_sizes(columns, axes[rows], angle[rows])
        stamp_ns = round((EPOCH_S + stamp_s[k]) * 1e9)
        header = {"seq": k, "t_ns": stamp_ns, "width": camera.width, "height": camera.height}
        messages.append(Detections.pack(columns, camera=name, **header))
    return messages


def _place(camera: Camera, wave: Wave, hand: Hand, t_s: Array) -> tuple[Array, Array]:
    """Markers (n, 3), one after the other, at their times (n,), and their normals (n, 3); camera's frame."""
    R, place = hand.pose(t_s)
    local = np.tile(wave.wand.points, (len(t_s) // len(wave.wand.markers), 1))
    T = invert(camera.matrix())
    world = np.einsum("nij,nj->ni", R, local) + place
    return world @ T[:3, :3].T + T[:3, 3], R[:, :, 2] @ T[:3, :3].T


def _with_sizes(roundels: Roundels, axes: Array, angle: Array) -> Roundels:
    one = np.ones(len(roundels))
    known = (np.sort(axes, axis=1)[:, ::-1], angle, 0.6 * one, 100 * one, roundels.id, roundels.track)
    return Roundels(roundels.uv, roundels.cov, *known)
