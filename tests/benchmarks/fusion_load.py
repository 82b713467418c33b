# SPDX-License-Identifier: BSD-3-Clause
"""Synthetic loads: the detections of many robots as messages, and the truth."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import Pose, look_at, rotation_from_vector
from camera_node.protocol.messages import Detections
from fusion.errors import FusionError
from fusion.model.frames import CalibratedFrame
from fusion.model.observations import CameraArray, Exposures, MarkerTable
from fusion.model.robots import Robot, require_distinct
from fusion.model.states import States
from tests.calib.synthetic import outlines

START_NS = 1_000_000_000_000
LENS = {"width": 1280, "height": 800, "fx": 840.0, "fy": 841.0, "cx": 642.0, "cy": 397.0}
DISTORTION = (-0.09, 0.02, 0.0003, -0.0002, 0.0)
DIAMETER_M = 0.08
HALF = np.array([2.6, 1.6])  # of the floor that robots drive on
FACING = 0.2  # cosine under which a print is not detected
MARGIN_PX = 10  # of an image, in which nothing is detected


@dataclass(frozen=True)
class Load:
    """Robots on Lissajous figures at different heights, with false and missing detections."""

    robots: int = 50
    markers: int = 4
    cameras: int = 8
    hz: float = 60.0
    speed_m_s: float = 1.0
    missing: float = 0.1
    false: float = 1.0  # detections per frame
    clutter: int = 0  # roundels on the walls that belong to no robot
    synchronised: bool = False
    sigma_px: float = 0.1
    crossing: bool = False  # through the whole arena, instead of each around its own point
    period_s: float | None = None  # after which all motions repeat; never unless given
    min_px: float = 0.0  # minor axes of smaller outlines are not detected
    seed: int = 1

    @property
    def half(self) -> np.ndarray:
        """Half the sides of the floor that robots drive on."""
        return HALF

    @cached_property
    def rig(self) -> dict[str, Camera]:
        """Cameras around the arena, directed at its centre."""
        a = 0.3 + 2 * np.pi * np.arange(self.cameras) / self.cameras
        at = np.column_stack([4.0 * np.cos(a), 3.0 * np.sin(a), 3.0 + 0.3 * np.cos(3 * a)])
        poses = [look_at(p, [0.0, 0.0, 0.2]) for p in at]
        return {
            f"cam{k}": Camera(**LENS, distortion=DISTORTION, T_world_cam=Pose.from_matrix(T))
            for k, T in enumerate(poses)
        }

    @cached_property
    def bodies(self) -> dict[str, Robot]:
        """Robots that only the distances of their markers distinguish; nothing distinguishes single markers."""
        rng = np.random.default_rng(self.seed)
        bodies: dict[str, Robot] = {}
        while len(bodies) < self.robots:
            robot = _robot(rng, self.markers)
            if robot.is_single or all(_differ(robot, other) for other in bodies.values()):
                bodies[f"r{len(bodies)}"] = robot
        return bodies

    @cached_property
    def paths(self) -> "Paths":
        rng = np.random.default_rng(self.seed + 1)
        n = self.robots
        half = self.half
        columns = int(np.ceil(np.sqrt(round(half[0] / half[1], 1) * n)))
        cell = np.column_stack([np.arange(n) % columns, np.arange(n) // columns])
        rows = int(np.ceil(n / columns))
        centre = (cell + 0.5) / [columns, rows] * 2 * half - half
        size = np.tile(half * 0.9, (n, 1)) if self.crossing else np.full((n, 2), 0.25)
        centre = 0 * centre if self.crossing else centre
        rate = rng.uniform(0.7, 1.3, (n, 2)) * self.speed_m_s / size
        turn = rng.uniform(-1.5, 1.5, n) * min(self.speed_m_s, 1.0)
        if self.period_s is not None:
            unit = 2 * np.pi / self.period_s
            rate, turn = unit * np.round(rate / unit), unit * np.round(turn / unit)
        height = rng.uniform(0.05, 0.8, n)
        return Paths(centre, size, rate, rng.uniform(0, 6.28, (n, 2)), turn, rng.uniform(0, 6.28, n), height)

    def phases(self) -> np.ndarray:
        """Time offsets of the cameras in periods."""
        n = self.cameras
        return (
            np.zeros(n)
            if self.synchronised
            else np.linspace(-0.45, 0.45, n)[np.argsort(np.sin(7.0 * np.arange(n)))]
        )

    def messages(self, seconds: float) -> Iterator[Detections]:
        """Detections of all cameras in order of time; `id` is the row of the marker table, -1 for false ones."""
        rng = np.random.default_rng(self.seed + 2)
        scene = Scene(self)
        stamps = (np.arange(round(seconds * self.hz))[:, None] + self.phases()) / self.hz
        for k in np.argsort(stamps, axis=None, kind="stable"):
            seq, camera = divmod(int(k), self.cameras)
            t_s = float(stamps[seq, camera])
            yield scene.detect(camera, seq, t_s, rng)

    def frames(self, seconds: float) -> Iterator[CalibratedFrame]:
        """The same as calibrated frames."""
        return (CalibratedFrame.of(message, self.rig[message.camera]) for message in self.messages(seconds))


@dataclass(frozen=True)
class Paths:
    """Positions and motions of the robots."""

    centre: np.ndarray
    size: np.ndarray
    rate: np.ndarray
    phase: np.ndarray
    turn: np.ndarray
    heading: np.ndarray
    height: np.ndarray

    def place(self, p: np.ndarray) -> None:
        """Place the robots at rest at p (N, 3)."""
        self.centre[:], self.size[:], self.rate[:], self.turn[:] = p[:, :2], 0, 0, 0
        self.height[:] = p[:, 2]

    def at(self, t_s: float) -> States:
        """The true states at a time, with zero covariances."""
        n, angle = len(self.turn), self.rate * t_s + self.phase
        p = np.column_stack([self.centre + self.size * np.sin(angle), self.height])
        v = np.column_stack([self.size * self.rate * np.cos(angle), np.zeros(n)])
        up = np.column_stack([np.zeros((n, 2)), np.ones(n)])
        R = rotation_from_vector(up * (self.heading + self.turn * t_s)[:, None])
        return States(R, p, up * self.turn[:, None], v, np.zeros((n, 12, 12)))


class Scene:
    """Computes what the cameras of a load detect; `cameras` are at their true places."""

    def __init__(self, load: Load) -> None:
        self.load, self.cameras = load, CameraArray(load.rig)
        self.marker_table = MarkerTable.of(list(load.bodies.values()))
        rng = np.random.default_rng(load.seed + 3)
        self.clutter = np.column_stack(
            [
                rng.uniform(-3, 3, load.clutter),
                rng.uniform(-2, 2, load.clutter),
                rng.uniform(1.2, 1.6, load.clutter),
            ]
        )

    def detect(self, camera: int, seq: int, t_s: float, rng: np.random.Generator) -> Detections:
        """One frame's message."""
        name, t_ns = self.cameras.names[camera], START_NS + round(t_s * 1e9)
        lens = self.load.rig[name]
        roundels = self.roundels(camera, self.load.paths.at((t_ns - START_NS) * 1e-9), rng)
        return Detections.pack(
            roundels, camera=name, seq=seq, t_ns=t_ns, sent_ns=t_ns, width=lens.width, height=lens.height
        )

    def roundels(
        self, camera: int, states: States, rng: np.random.Generator, hidden: Collection[int] = ()
    ) -> Roundels:
        """The roundels in one frame of a camera; those of the robots in `hidden` are covered."""
        exposures = Exposures.exact(np.array([camera]), np.zeros(1))
        n = len(self.marker_table)
        views = self.cameras.views(
            states, exposures, self.marker_table.discs(np.arange(n), np.zeros(n, np.intp))
        )
        R, at = self.cameras.R_cam_world[camera], self.cameras.centres[camera]
        c = np.column_stack([views.centre, R @ (self.clutter - at).T])
        normal = np.column_stack([views.normal, np.tile(R[:, 2:], len(self.clutter))])
        row = np.concatenate([np.arange(n), np.full(len(self.clutter), -1)])
        seen = (-np.einsum("in,in->n", c, normal) > FACING * np.linalg.norm(c, axis=0)) & (c[2] > 0.1)
        seen &= rng.random(len(seen)) >= self.load.missing
        seen[:n] &= ~np.isin(self.marker_table.robot, list(hidden))
        lens = self.cameras[self.cameras.names[camera]]
        return self._noisy(lens, c[:, seen], normal[:, seen], row[seen], rng)

    def _noisy(self, lens: Camera, c, normal, row, rng: np.random.Generator) -> Roundels:
        sigma = self.load.sigma_px
        uv, axes, angle = outlines(lens, c.T, normal.T, DIAMETER_M / 2)
        least, most = MARGIN_PX, np.array([lens.width, lens.height]) - MARGIN_PX
        inside = ((uv > least) & (uv < most)).all(1)
        inside &= axes[:, 1] >= self.load.min_px
        extra = rng.poisson(self.load.false)
        uv = np.concatenate(
            [
                uv[inside],
                rng.uniform(least, most, (extra, 2)),
            ]
        )
        axes = np.concatenate([axes[inside], np.sort(rng.uniform(10, 30, (extra, 2)))[:, ::-1]])
        uv, axes = uv + sigma * rng.normal(size=uv.shape), axes + sigma * rng.normal(size=axes.shape)
        n = len(uv)
        angle = np.concatenate([angle[inside], rng.uniform(-1.5, 1.5, extra)])
        number = np.concatenate([row[inside], np.full(extra, -1)]).astype(np.int32)
        cov, level = np.tile(sigma**2 * np.eye(2), (n, 1, 1)), np.full(n, 0.6)
        roundels = Roundels(uv, cov, axes, angle, level, 200 * level, number, number)
        return roundels.select(rng.permutation(n))


def _robot(rng: np.random.Generator, markers: int) -> Robot:
    if markers == 1:
        return Robot(diameter_m=DIAMETER_M)
    while True:
        corners = np.column_stack([rng.uniform(-0.17, 0.17, (markers, 2)), np.zeros(markers)])
        apart = np.linalg.norm(corners[:, None] - corners[None], axis=2) + np.eye(markers)
        if apart.min() > 1.3 * DIAMETER_M:
            try:
                return Robot(diameter_m=DIAMETER_M, markers=tuple(map(tuple, corners.tolist())))
            except ValueError:  # on one line
                continue


def _differ(a: Robot, b: Robot) -> bool:
    try:
        require_distinct({"a": a, "b": b})
    except FusionError:
        return False
    return True
