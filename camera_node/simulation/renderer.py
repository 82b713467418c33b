# SPDX-License-Identifier: BSD-3-Clause
"""Images of a simulated arena, by tracing the rays of a distorting lens onto printed discs.

The truth that detectors are measured against, so it shares no model with them: no ellipse and no model of an edge
stands in here. Each sub-sample of a pixel is a viewing ray that meets a disc's plane at some radius.
"""

import math
import zlib
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.arrays import Array, Grey
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert
from camera_node.simulation.background import paint_floor, plain_floor, view_floor
from camera_node.simulation.scene import Scene

Picture = NDArray[np.float32]
WHITE, BLACK = 215.0, 28.0  # grey levels of paper and print where the lens lets all light through
SUBSAMPLES = 3  # each pixel is traced at 3 x 3 places; edges come out right to 0.5 % of the contrast
NEAR_M = 0.05
EDGE_ON = 0.02  # flatter views, less than half a pixel high, would bring the plane's horizon into the picture
CORNERS = np.linspace(0, math.tau, 12, endpoint=False)
POLYGON = np.column_stack([np.cos(CORNERS), np.sin(CORNERS)]) / math.cos(
    math.pi / 12
)  # around the unit circle
NOISE_SHIFTS = 128  # one field of noise serves all frames, shifted at random by up to so many pixels


@dataclass(frozen=True, slots=True)
class Disc:
    """A printed roundel before a camera: T_cam_disc (4, 4), and its radii: card, black disc, white disc; metres."""

    T: Array
    radii: tuple[float, float, float]

    @property
    def faces_camera(self) -> bool:
        """Whether the camera sees the printed side, from more than EDGE_ON radians above its plane."""
        t = self.T[:3, 3]
        return float(self.T[:3, 2] @ t) < -EDGE_ON * float(np.linalg.norm(t))

    def outline(self) -> Array:
        """(12, 3) corners, camera frame, of a polygon around the card."""
        return self.radii[0] * POLYGON @ self.T[:3, :2].T + self.T[:3, 3]


def discs_of(body: Body, T_cam_body: Array) -> list[Disc]:
    """The roundels of a body at T_cam_body (4, 4), seen or not."""
    outer = body.diameter_m / 2
    radii = (outer * body.surround_ratio, outer, outer * body.inner_ratio)
    discs = []
    for point in body.points:
        T = T_cam_body.copy()
        T[:3, 3] += T_cam_body[:3, :3] @ point
        discs.append(Disc(T, radii))
    return discs


class Renderer:
    """What one camera of a scene sees at any time."""

    def __init__(self, scene: Scene, name: str) -> None:
        """Raises ConfigError where the scene has no camera `name`."""
        self.scene, self.camera = scene, scene.camera(name)
        self._T_cam_world = invert(self.camera.T_world_cam)
        self._reach = math.ceil(4 * self.camera.blur_px)  # pixels over which the blur spreads
        self._margin = self._reach + 2
        self._rays = map_rays(self.camera, self._margin)
        # Outside this radius x/z, y/z nothing is seen: the corners' with room for a disc that is cut there.
        self._limit = 1.15 * float(np.linalg.norm(self._rays, axis=2).max())
        self._gain = vignette(self.camera)
        self._seed = zlib.crc32(f"{scene.seed} {name}".encode())
        self._noise = self._draw_noise()
        self._backdrop = self._view_backdrop()

    def render(self, t_s: float, frame: int = 0) -> Grey:
        """The image (h, w), uint8, of an exposure whose middle is `t_s`; `frame` alone decides its noise."""
        image = self._backdrop.copy()
        for instants in self._visible_discs(t_s):
            self._paint(image, instants)
        return self._add_noise(image, frame)

    def _visible_discs(self, t_s: float) -> list[list[Disc]]:
        """Roundels that face the camera, the farthest first; of each its disc at all instants of the exposure."""
        n, exposure_s = self.camera.motion_samples, self.camera.exposure_us * 1e-6
        instants = [self._discs_at(t_s + ((k + 0.5) / n - 0.5) * exposure_s) for k in range(n)]
        middle = {key: disc for key, disc in instants[n // 2].items() if disc.faces_camera}
        farthest_first = sorted(middle, key=lambda key: -float(np.linalg.norm(middle[key].T[:3, 3])))
        return [[discs.get(key, middle[key]) for discs in instants] for key in farthest_first]

    def _discs_at(self, t_s: float) -> dict[tuple[str, int], Disc]:
        """Every roundel in the arena, by its body and number."""
        bodies = self.scene.bodies_at(t_s).items()
        discs = ((name, discs_of(body, self._T_cam_world @ T)) for name, (body, T) in bodies)
        return {(name, k): disc for name, own in discs for k, disc in enumerate(own)}

    def _paint(self, image: Picture, instants: list[Disc]) -> None:
        """Put one roundel over what is there: its card hides it in proportion to the card's part of the pixel."""
        box = self._bound(instants)
        if box is None:
            return
        u0, v0, u1, v1 = box
        layers = [self._trace(disc, box) for disc in instants]
        card, light = cv2.split(sum(layers[1:], layers[0]) / len(layers))
        seen = (slice(max(v0, 0), v1), slice(max(u0, 0), u1))
        h, w = image[seen].shape
        inside = (slice(max(-v0, 0), max(-v0, 0) + h), slice(max(-u0, 0), max(-u0, 0) + w))
        image[seen] += light[inside] * self._gain[seen] - card[inside] * image[seen]

    def _bound(self, instants: list[Disc]) -> tuple[int, int, int, int] | None:
        """Columns and rows u0, v0, u1, v1 that the discs can touch, within the rays that are known; or None."""
        points = np.concatenate([disc.outline() for disc in instants])
        z, radii = points[:, 2], np.hypot(points[:, 0], points[:, 1])
        if z.min() < NEAR_M or (radii > self._limit * z).all():
            return None
        size, known = np.array((self.camera.width, self.camera.height)), self._reach + 1
        if (radii > self._limit * z).any():  # out there a lens model may fold back: anywhere in the image
            return (-known, -known, *(size + known).tolist())
        uv = self.camera.project(points)
        low = np.floor(uv.min(0)).astype(int) - self._reach
        high = np.ceil(uv.max(0)).astype(int) + self._reach + 1
        if (high <= 0).any() or (low >= size).any():
            return None
        return (*np.maximum(low, -known).tolist(), *np.minimum(high, size + known).tolist())

    def _trace(self, disc: Disc, box: tuple[int, int, int, int]) -> Picture:
        """(h, w, 2) of a box: how much of each pixel the card covers, and the light from there, both blurred."""
        u0, v0, u1, v1 = box
        m = self._margin - 1  # one pixel more on each side for the slope
        rays = self._rays[v0 + m : v1 + m + 2, u0 + m : u1 + m + 2]
        fine = cv2.resize(rays, None, fx=SUBSAMPLES, fy=SUBSAMPLES, interpolation=cv2.INTER_LINEAR)
        radius = trace_radius(disc, np.asarray(fine, np.float32))
        rim = SUBSAMPLES - 1
        card, black, white = cover(radius[rim:-rim, rim:-rim], disc.radii)
        layers = cv2.merge([card, WHITE * card - (WHITE - BLACK) * (black - white)])
        blurred = cv2.GaussianBlur(
            layers, (0, 0), self.camera.blur_px * SUBSAMPLES, borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(cv2.resize(blurred, (u1 - u0, v1 - v0), interpolation=cv2.INTER_AREA), np.float32)

    def _view_backdrop(self) -> Picture:
        m = self._margin
        floor = paint_floor(self.scene.seed) if self.scene.clutter else plain_floor()
        seen = view_floor(floor, self._rays, self.camera.T_world_cam)
        sharp = np.ascontiguousarray(seen[m:-m, m:-m])
        return cv2.GaussianBlur(sharp, (0, 0), self.camera.blur_px) * self._gain

    def _draw_noise(self) -> Picture:
        shape = (self.camera.height + NOISE_SHIFTS, self.camera.width + NOISE_SHIFTS)
        noise = np.random.default_rng(self._seed).standard_normal(shape, np.float32)
        return noise * np.float32(self.camera.noise)

    def _add_noise(self, image: Picture, frame: int) -> Grey:
        du, dv = np.random.default_rng((self._seed, frame)).integers(0, NOISE_SHIFTS, 2)
        h, w = image.shape
        noise = self._noise[dv : dv + h, du : du + w]
        return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)  # rounds and saturates


def trace_radius(disc: Disc, rays: Picture) -> Picture:
    """Distance (h, w) from the disc's centre, metres, of where rays (h, w, 2: x/z, y/z) meet its plane."""
    to_plane = np.linalg.inv(np.column_stack([disc.T[:3, :2], disc.T[:3, 3]]))  # p = [e1 e2 t] (a, b, 1) s
    points = cv2.perspectiveTransform(rays, to_plane)
    return np.asarray(cv2.magnitude(points[..., 0], points[..., 1]), np.float32)


def cover(radius: Picture, radii: tuple[float, ...]) -> list[Picture]:
    """What part of each cell (h, w) lies within each of the radii, from `radius` (h + 2, w + 2) at the cells' centres.

    Across an edge the part falls from 1 to 0 over one cell along the steeper axis: then the cells of a column (or row)
    that an edge crosses add up to where it crosses that column's middle, whatever the edge's direction.
    """
    across = cv2.absdiff(radius[1:-1, 2:], radius[1:-1, :-2])
    down = cv2.absdiff(radius[2:, 1:-1], radius[:-2, 1:-1])
    cell = cv2.max(across, down) / 2 + np.float32(1e-9)
    center = radius[1:-1, 1:-1]
    return [(0.5 + (np.float32(r) - center) / cell).clip(0, 1) for r in radii]


def map_rays(lens: Lens, margin: int) -> Picture:
    """(h + 2 margin, w + 2 margin, 2): x/z and y/z of each pixel's ray, of `margin` pixels around the image too.

    Far outside where the distortion has no inverse.
    """
    u, v = np.arange(-margin, lens.width + margin), np.arange(-margin, lens.height + margin)
    rays = lens.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    return np.nan_to_num(rays, nan=1e3).reshape(len(v), len(u), 2).astype(np.float32)


def vignette(lens: Lens) -> Picture:
    """How much of the light arrives at each pixel (h, w): all at the centre, 70 % in the corners."""
    u, v = np.meshgrid(np.linspace(-1, 1, lens.width), np.linspace(-1, 1, lens.height))
    return (1 - 0.15 * (u**2 + v**2)).astype(np.float32)
