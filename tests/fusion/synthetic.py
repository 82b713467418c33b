# SPDX-License-Identifier: BSD-3-Clause
"""A synthetic arena: detections by free-running cameras of robots with known motion."""

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.camera_errors import usual_covariance, working_ranges
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import Pose, look_at, rotation_from_vector
from camera_node.protocol.messages import Detections
from fusion.model.frames import CalibratedFrame
from fusion.model.marker_places import PLACE_M
from fusion.model.observations import MarkerTable
from fusion.model.robots import Robot
from tests.calib.synthetic import fit_ellipses
from tests.fusion.equations import outlines

PERIOD_NS = 33_333_333
START_NS = 1_000_000_000_000
ROTATION_SIGMA = 0.005  # rad, of codes
ROW_STEPS, STEP_S = 4, 1e-4  # of the iteration for the rows of markers; of a difference quotient
Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]

TRIANGLE = Robot(diameter_m=0.12, markers=((0.15, 0.0, 0.0), (-0.13, 0.14, 0.0), (-0.03, -0.14, 0.0)))
WIDE = Robot(diameter_m=0.12, markers=((-0.13, 0.07, 0.0), (-0.08, -0.18, 0.0), (0.21, 0.10, 0.0)))
SINGLE = Robot(diameter_m=0.12)
EQUILATERAL = tuple(
    (0.15 * np.cos(a), 0.15 * np.sin(a), 0.0) for a in np.radians([0.0, 120.0, 240.0])
)  # symmetric


def ring(
    n: int = 4,
    distortion: tuple[float, ...] = (-0.1, 0.02, 0.0003, -0.0002, 0.0),
    height_m: float = 3.0,
) -> dict[str, Camera]:
    """`n` cameras around the arena, directed at its centre."""
    angles = 0.3 + 2 * np.pi * np.arange(n) / n
    poses = [look_at([2.5 * np.cos(a), 2.5 * np.sin(a), height_m], [0.0, 0.0, 0.2]) for a in angles]
    lens = {"width": 800, "height": 600, "fx": 650.0, "fy": 651.0, "cx": 402.0, "cy": 297.0}
    return {
        f"cam{k}": Camera(**lens, distortion=distortion, T_world_cam=Pose.from_matrix(T))
        for k, T in enumerate(poses)
    }


def measured(robot: Robot, rng: np.random.Generator) -> Robot:
    """A robot as someone measured it."""
    points = robot.points + PLACE_M * rng.standard_normal(robot.points.shape)
    return msgspec.structs.replace(robot, markers=tuple(map(tuple, points.tolist())))


def precise(cameras: dict[str, Camera], error_px: float = 1e-3) -> dict[str, Camera]:
    """The cameras, with covariances that claim this error in the image."""
    ranges = working_ranges(list(cameras.values())).tolist()
    return {
        name: msgspec.structs.replace(
            camera, covariance=tuple(map(tuple, usual_covariance(camera, range_m, error_px).tolist()))
        )
        for (name, camera), range_m in zip(cameras.items(), ranges, strict=True)
    }


def line(
    start: tuple, velocity: tuple = (0, 0, 0), turn: tuple = (0, 0, 0), tilt: tuple = (0, 0, 0)
) -> Motion:
    """Uniform linear and angular motion: R and p at t seconds."""

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        R = rotation_from_vector(np.multiply(turn, t)) @ rotation_from_vector(tilt)
        return R, np.array(start, float) + np.multiply(velocity, t)

    return at


def circle(turn_s: float, radius_m: float, height_m: float = 0.2) -> Motion:
    """A drive around the origin in so many seconds a turn, the robot's x axis along the motion."""

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        c, s = np.cos(2 * np.pi * t / turn_s), np.sin(2 * np.pi * t / turn_s)
        R = np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 1.0]])
        return R, np.array([radius_m * c, radius_m * s, height_m])

    return at


def drive(radius_m: float, speed_m_s: float) -> Motion:
    """A drive in a circle from rest; the speed is reached after a second."""

    def at(t: float) -> tuple[np.ndarray, np.ndarray]:
        way = speed_m_s * (t**2 / 2 if 0 < t < 1 else max(t - 0.5, 0.0))
        c, s = np.cos(way / radius_m), np.sin(way / radius_m)
        return np.array([[-s, -c, 0.0], [c, -s, 0.0], [0.0, 0.0, 1.0]]), np.array(
            [radius_m * c, radius_m * s, 0.2]
        )

    return at


@dataclass
class Arena:
    """Robots and their motions; `frames` renders what each camera detects.

    `phases` are the time offsets of the cameras in periods; `hidden(robot, marker, t)` hides markers. A print is
    detected if the cosine of its slant is above `min_facing`. Cameras read all rows in `readout_s`; each marker is seen
    when its row is read. The card of marker k is turned by k times `card_turn_rad`.
    """

    robots: dict[str, Robot]
    motions: dict[str, Motion]
    cameras: dict[str, Camera] = field(default_factory=ring)
    phases: tuple[float, ...] = (0.0, 0.27, -0.41, 0.38)
    sigma_px: float = 0.0
    readout_s: float = 0.0
    distractors: int = 0
    seed: int = 1
    hidden: Callable[[str, int, float], bool] = lambda robot, marker, t: False
    min_facing: float = 0.0
    card_turn_rad: float = 0.0

    def frames(self, n: int) -> list[CalibratedFrame]:
        """`n` frames of every camera, in order of time."""
        rng = np.random.default_rng(self.seed)
        times = sorted(
            (START_NS + round((k + phase) * PERIOD_NS), name)
            for name, phase in zip(self.cameras, self.phases, strict=False)
            for k in range(n)
        )
        ideal = {
            name: self._ideal(name, [(t_ns - START_NS) * 1e-9 for t_ns, seen_by in times if seen_by == name])
            for name in self.cameras
        }
        return [
            CalibratedFrame.measure(
                name,
                t_ns,
                self._disturb(next(ideal[name]), rng),
                self.cameras[name],
                readout_s=self.readout_s,
            )
            for t_ns, name in times
        ]

    def messages(self, n: int) -> list[Detections]:
        """The same as messages of the cameras."""
        return [
            Detections.pack(
                f.roundels,
                camera=f.camera,
                seq=k,
                t_ns=f.t_ns,
                width=800,
                height=600,
                readout_us=1e6 * self.readout_s,
            )
            for k, f in enumerate(self.frames(n))
        ]

    @staticmethod
    def seconds(t_ns: int) -> float:
        """Since the start."""
        return (t_ns - START_NS) * 1e-9

    def truth(self, robot: str, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """R and p."""
        return self.motions[robot]((t_ns - START_NS) * 1e-9)

    def detect(self, name: str, t: float, rng: np.random.Generator) -> Roundels:
        """What a camera detects in a frame whose middle is read at t seconds."""
        return self._disturb(next(self._ideal(name, [t])), rng)

    def _ideal(self, name: str, times: list[float]) -> Iterator[tuple[np.ndarray, ...]]:
        """The outlines of the discs in each of a camera's frames, without noise.

        The centres come from sampled circles, independently of the model under test.

        Yields:
            For each frame the columns uv and axes (N, 2), angles (N,), rows of the marker table, codes, and the
            rotations of codes.
        """
        camera = self.cameras[name]
        table = MarkerTable.of(list(self.robots.values()))
        robots = list(self.robots)
        owners = [(robots[r], int(m)) for r, m in zip(table.robot, table.number, strict=True)]
        hidden = [[self.hidden(robot, m, t) for robot, m in owners] for t in times]
        frame, row = np.nonzero(~np.array(hidden, bool).reshape(len(times), len(owners)))
        middle = np.array(times, float)[frame]
        t_s = middle
        for _ in range(ROW_STEPS if self.readout_s else 0):
            uv = camera.project_world(self._place(table, row, t_s)[0])
            t_s = middle + self.readout_s * np.nan_to_num(camera.image_row(uv)).clip(-0.5, 0.5)
        (centre, normal, zero), (later, *_) = (self._place(table, row, t_s + dt) for dt in (0.0, STEP_S))
        speed = (camera.project_world(later) - camera.project_world(centre)) / STEP_S
        to = camera.matrix()[:3, 3] - centre
        facing = np.einsum("ni,ni->n", normal, to) > self.min_facing * np.linalg.norm(to, axis=1)
        radius, code, uv = table.radius[row], table.code[row], np.full((len(centre), 2), np.nan)
        uv[facing] = outline_centres(camera, centre[facing], normal[facing], radius[facing])
        inside = ((uv > 15) & (uv < [785, 585])).all(1)
        uv, frame, row, centre, normal, zero, speed, radius, code = (
            column[inside] for column in (uv, frame, row, centre, normal, zero, speed, radius, code)
        )
        shear = speed * self.readout_s / camera.height
        S = np.linalg.inv(np.eye(2) - shear[:, :, None] * [0.0, 1.0])
        shape = S @ self._outlines(camera, centre, normal, radius) @ S.transpose(0, 2, 1)
        values, vectors = np.linalg.eigh(shape)
        rim = camera.project_world(centre + radius[:, None] * zero).reshape(-1, 2) - uv
        q = np.einsum("nji,nj->ni", vectors, rim) / np.sqrt(values)
        q = np.einsum("nij,nj->ni", vectors, q)
        angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        turn = np.arctan2(q[:, 1], q[:, 0])
        columns = (uv, 2 * np.sqrt(values[:, ::-1]), angle, row, code, turn)
        starts = np.searchsorted(frame, np.arange(1, len(times)))
        return zip(*(np.split(column, starts) for column in columns), strict=True)

    def _place(
        self, markers: MarkerTable, rows: np.ndarray, t_s: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Centres, normals and directions to the zeros of codes (N, 3) of markers, each at its own time (N,)."""
        robots = list(self.robots)
        pose = functools.cache(lambda robot, t: self.motions[robots[robot]](t))
        poses = [pose(r, t) for r, t in zip(markers.robot[rows].tolist(), t_s.tolist(), strict=True)]
        R = np.array([R for R, _ in poses]).reshape(-1, 3, 3)
        p = np.array([p for _, p in poses]).reshape(-1, 3)
        centre = p + np.einsum("nij,jn->ni", R, markers.position[:, rows])
        axes = np.concatenate([robot.code_axes for robot in self.robots.values()])[rows]
        turn = self.card_turn_rad * markers.number[rows][:, None]
        normals = markers.normal.T[rows]
        axes = np.cos(turn) * axes + np.sin(turn) * np.cross(normals, axes)
        normal, zero = (np.einsum("nij,nj->ni", R, v) for v in (normals, axes))
        return centre, normal, zero

    def _disturb(self, ideal: tuple[np.ndarray, ...], rng: np.random.Generator) -> Roundels:
        """The discs of one frame with noise and distractors, in any order; `id` is the code, or else the row of the
        marker table, -1 for distractors."""
        uv, axes, angle, row, code, turn = ideal
        extra = self.distractors
        uv = np.vstack([uv, rng.uniform([20, 20], [780, 580], (extra, 2))])
        axes = np.vstack([axes, np.sort(rng.uniform(10, 30, (extra, 2)))[:, ::-1]])
        angle = np.concatenate([angle, rng.uniform(-1.5, 1.5, extra)])
        uv = uv + rng.normal(0, 1, uv.shape) * self.sigma_px
        axes = np.maximum(axes + rng.normal(0, 1, axes.shape) * self.sigma_px, 1)
        n, order = len(uv), rng.permutation(len(uv))
        cov = np.tile(max(self.sigma_px, 1e-3) ** 2 * np.eye(2), (n, 1, 1))
        level, none = np.full(n, 0.6), np.full(n, -1, np.int32)
        unread = np.full(extra, np.nan)
        number = np.concatenate([np.where(code > 0, code, row), np.full(extra, -1)]).astype(np.int32)
        sure, turn, sigma = (
            np.concatenate([np.where(code > 0, value, np.nan), unread])
            for value in (1.0, turn, ROTATION_SIGMA)
        )
        turn = turn + ROTATION_SIGMA * np.sign(self.sigma_px) * np.cos(1e6 * uv[:, 0])
        columns = (uv, cov, axes, angle, level, 200 * level, number, none, sure, turn, sigma)
        return Roundels(*columns).select(order)

    def _outlines(self, camera: Camera, centre, normal, radius) -> np.ndarray:
        """(N, 2, 2) shape matrices."""
        T = np.linalg.inv(camera.matrix())
        c, n = T[:3, :3] @ centre.T + T[:3, 3:], T[:3, :3] @ normal.T
        scale = camera.project_with_jacobian((c / c[2]).T)[1][:, :, :2].transpose(1, 2, 0)
        return outlines(c, n, radius, scale)


def outline_centres(camera: Camera, centre: np.ndarray, normal: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """The centres (N, 2) of the ellipses through the images of discs' rims, as a detector fits them, raw pixels."""
    u = np.linalg.svd(normal[:, None])[2][:, 1:]
    phi = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = centre[:, None] + radius[:, None, None] * (np.column_stack([np.cos(phi), np.sin(phi)]) @ u)
    uv = camera.project_world(rim.reshape(-1, 3)).reshape(-1, 16, 2)
    seen, found = np.isfinite(uv).all(axis=(1, 2)), np.full((len(uv), 2), np.nan)
    found[seen] = fit_ellipses(uv[seen])[0]
    return found
