# SPDX-License-Identifier: BSD-3-Clause
"""A synthetic arena: detections by free-running cameras of robots with known motion."""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.geometry.pose import Pose, look_at, rotation_from_vector
from camera_node.protocol.messages import Detections
from fusion.model.camera_array import CameraArray
from fusion.model.frames import CalibratedFrame
from fusion.model.observations import MarkerTable
from fusion.model.robots import Robot
from tests.fusion.equations import outlines

PERIOD_NS = 33_333_333
START_NS = 1_000_000_000_000
Motion = Callable[[float], tuple[np.ndarray, np.ndarray]]

TRIANGLE = Robot(diameter_m=0.12, markers=((0.15, 0.0, 0.0), (-0.13, 0.14, 0.0), (-0.03, -0.14, 0.0)))
WIDE = Robot(diameter_m=0.12, markers=((-0.13, 0.07, 0.0), (-0.08, -0.18, 0.0), (0.21, 0.10, 0.0)))
SINGLE = Robot(diameter_m=0.12)


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


@dataclass
class Arena:
    """Robots and their motions; `frames` renders what each camera detects.

    `phases` are the time offsets of the cameras in periods; `hidden(robot, marker, t)` hides markers. A print is
    detected if the cosine of its slant is above `min_facing`.
    """

    robots: dict[str, Robot]
    motions: dict[str, Motion]
    cameras: dict[str, Camera] = field(default_factory=ring)
    phases: tuple[float, ...] = (0.0, 0.27, -0.41, 0.38)
    sigma_px: float = 0.0
    distractors: int = 0
    seed: int = 1
    hidden: Callable[[str, int, float], bool] = lambda robot, marker, t: False
    min_facing: float = 0.0

    def frames(self, n: int) -> list[CalibratedFrame]:
        """`n` frames of every camera, in order of time."""
        rng = np.random.default_rng(self.seed)
        times = sorted(
            (START_NS + round((k + phase) * PERIOD_NS), name)
            for name, phase in zip(self.cameras, self.phases, strict=False)
            for k in range(n)
        )
        return [
            CalibratedFrame.measure(
                name, t_ns, self.detect(name, (t_ns - START_NS) * 1e-9, rng), self.cameras[name]
            )
            for t_ns, name in times
        ]

    def messages(self, n: int) -> list[Detections]:
        """The same as messages of the cameras."""
        return [
            Detections.pack(f.roundels, camera=f.camera, seq=k, t_ns=f.t_ns, width=800, height=600)
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
        """What a camera detects at t seconds."""
        cameras = CameraArray({name: self.cameras[name]})
        marker_table = MarkerTable.of(list(self.robots.values()))
        seen = [
            k
            for k, (r, m) in enumerate(zip(marker_table.robot, marker_table.number, strict=True))
            if not self.hidden(list(self.robots)[r], int(m), t)
        ]
        poses = [self.motions[robot](t) for robot in self.robots]
        R = np.array([pose[0] for pose in poses])[marker_table.robot[seen]].reshape(-1, 3, 3)
        p = np.array([pose[1] for pose in poses])[marker_table.robot[seen]].reshape(-1, 3)
        centre = p + np.einsum("nij,jn->ni", R, marker_table.position[:, seen])
        normal = np.einsum("nij,jn->ni", R, marker_table.normal[:, seen])
        number = np.array(seen, np.int32)
        return self._roundels(cameras, number, (centre, normal, marker_table.radius[seen]), rng)

    def _roundels(self, cameras: CameraArray, number, discs, rng: np.random.Generator) -> Roundels:
        """Outlines of discs; `id` is the row of the marker table, -1 for distractors.

        The centres come from sampled circles, independently of the model under test.
        """
        camera, (centre, normal, radius) = cameras[cameras.names[0]], discs
        to = cameras.centres[0] - centre
        facing = np.einsum("ni,ni->n", normal, to) > self.min_facing * np.linalg.norm(to, axis=1)
        number, centre, normal, radius = number[facing], centre[facing], normal[facing], radius[facing]
        uv = np.array([outline_centre(camera, *disc) for disc in zip(centre, normal, radius, strict=True)])
        uv = uv.reshape(-1, 2)
        inside = ((uv > 15) & (uv < [785, 585])).all(1)
        number, uv, centre = number[inside], uv[inside], centre[inside]
        normal, radius = normal[inside], radius[inside]
        shape = self._outlines(camera, centre, normal, radius)
        values, vectors = np.linalg.eigh(shape) if len(uv) else (np.zeros((0, 2)), np.zeros((0, 2, 2)))
        axes = 2 * np.sqrt(values[:, ::-1])
        angle = np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
        extra = self.distractors
        uv = np.vstack([uv, rng.uniform([20, 20], [780, 580], (extra, 2))])
        axes = np.vstack([axes, np.sort(rng.uniform(10, 30, (extra, 2)))[:, ::-1]])
        angle = np.concatenate([angle, rng.uniform(-1.5, 1.5, extra)])
        uv = uv + rng.normal(0, 1, uv.shape) * self.sigma_px
        axes = np.maximum(axes + rng.normal(0, 1, axes.shape) * self.sigma_px, 1)
        n, order = len(uv), rng.permutation(len(uv))
        cov = np.tile(max(self.sigma_px, 1e-3) ** 2 * np.eye(2), (n, 1, 1))
        level, none = np.full(n, 0.6), np.full(n, -1, np.int32)
        number = np.concatenate([number, np.full(extra, -1, np.int32)])
        return Roundels(uv, cov, axes, angle, level, 200 * level, number, none).select(order)

    def _outlines(self, camera: Camera, centre, normal, radius) -> np.ndarray:
        """(N, 2, 2) shape matrices."""
        T = np.linalg.inv(camera.matrix())
        c, n = T[:3, :3] @ centre.T + T[:3, 3:], T[:3, :3] @ normal.T
        scale = camera.project_with_jacobian((c / c[2]).T)[1][:, :, :2].transpose(1, 2, 0)
        return outlines(c, n, radius, scale)


def outline_centre(camera: Camera, centre: np.ndarray, normal: np.ndarray, radius: float) -> np.ndarray:
    """The centre of a disc's outline: that of a conic through projected points of the rim, undistorted."""
    u = np.linalg.svd(normal[None])[2][1:]
    phi = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    rim = centre + radius * (np.cos(phi)[:, None] * u[0] + np.sin(phi)[:, None] * u[1])
    T = np.linalg.inv(camera.matrix())
    P = rim @ T[:3, :3].T + T[:3, 3]
    xy = P[:, :2] / P[:, 2:]
    middle, scale = xy.mean(0), np.ptp(xy)
    x, y = ((xy - middle) / scale).T
    a, b, c, d, e, _ = np.linalg.svd(np.column_stack([x * x, x * y, y * y, x, y, np.ones(16)]))[2][-1]
    point = np.linalg.solve([[2 * a, b], [b, 2 * c]], [-d, -e]) * scale + middle
    return camera.project([[*point, 1.0]])[0]
