# SPDX-License-Identifier: BSD-3-Clause
"""Renders images of a simulated arena by tracing the viewing rays of a distorting lens onto printed discs.

The images test detectors, so the renderer shares no model with them: it contains no ellipse and no edge model. The
viewing ray of each sub-sample of a pixel is intersected with a disc's plane, at some distance from the disc's centre.
With a rolling shutter, the disc is where it is when the pixel's row is read.
"""

import math
import zlib
from collections.abc import Mapping, Sequence

import cv2
import numpy as np

from camera_node.foundation.arrays import Array, Grey
from camera_node.geometry import codes
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert
from camera_node.simulation.discs import Disc, RollingDisc, discs_while_read, place_discs
from camera_node.simulation.floor import SUBSAMPLES, Picture, paint_floor, plain_floor, view_floor
from camera_node.simulation.scene import Scene, SceneCamera

WHITE, BLACK = 215.0, 28.0  # grey levels of paper and print without vignetting
NEAR_M = 0.05  # discs that come nearer to the camera's plane are not drawn
NOISE_SHIFTS = 128  # pixels; all frames use one noise image, shifted at random by less than this


class ImageModel:
    """What a camera makes of printed discs in front of a background: lens, blur, vignetting, sensor noise.

    Args:
        camera: its lens, blur and sensor; its pose is not used.
        seed: of the noise.
    """

    def __init__(self, camera: SceneCamera, seed: int) -> None:
        self.camera = camera
        self._reach = math.ceil(4 * camera.blur_px)  # pixels to which the blur extends
        self._margin = self._reach + 2
        self._rays = map_rays(camera, self._margin)
        # No disc beyond this radius in x/z, y/z is visible: that of the corners, plus a margin for clipped discs.
        self._limit = 1.15 * float(np.linalg.norm(self._rays, axis=2).max())
        self._gain = vignette(camera)
        self._seed = seed
        self._noise = self._draw_noise()

    def view(self, floor: Picture, T_world_cam: Array, subsamples: int = SUBSAMPLES) -> Picture:
        """The light (h, w) from a floor (`background.paint_floor`) that arrives at a camera at T_world_cam (4, 4)."""
        m = self._margin
        seen = view_floor(floor, self._rays, T_world_cam, subsamples)
        sharp = np.ascontiguousarray(seen[m:-m, m:-m])
        return cv2.GaussianBlur(sharp, (0, 0), self.camera.blur_px) * self._gain

    def paint(self, image: Picture, samples: Sequence[Disc | RollingDisc]) -> None:
        """Draw one roundel, at all sample times of the exposure.

        It replaces the light of each pixel in proportion to the card's share of the pixel.
        """
        box = self._bound(samples)
        if box is None:
            return
        u0, v0, u1, v1 = box
        layers = [self._trace(disc, box) for disc in samples]
        card, light = cv2.split(sum(layers[1:], layers[0]) / len(layers))
        seen = (slice(max(v0, 0), v1), slice(max(u0, 0), u1))
        h, w = image[seen].shape
        inside = (slice(max(-v0, 0), max(-v0, 0) + h), slice(max(-u0, 0), max(-u0, 0) + w))
        image[seen] += light[inside] * self._gain[seen] - card[inside] * image[seen]

    def expose(self, image: Picture, frame: int) -> Grey:
        """The picture (h, w), uint8, of light (h, w); `frame` seeds its noise."""
        du, dv = np.random.default_rng((self._seed, frame)).integers(0, NOISE_SHIFTS, 2)
        h, w = image.shape
        noise = self._noise[dv : dv + h, du : du + w]
        if self.camera.sensor == "clean":  # the same as `develop`, in a fifth of the time
            return np.asarray(cv2.add(image, noise, dtype=cv2.CV_8U), np.uint8)  # rounds and saturates
        return self.camera.sensor_model.develop(image, noise)

    def _bound(self, samples: Sequence[Disc | RollingDisc]) -> tuple[int, int, int, int] | None:
        """Columns and rows u0, v0, u1, v1 that the discs may cover, within the range of `_rays`; None without any."""
        points = np.concatenate([disc.outline() for disc in samples])
        z, radii = points[:, 2], np.hypot(points[:, 0], points[:, 1])
        if z.min() < NEAR_M or (radii > self._limit * z).all():
            return None
        size, known = np.array((self.camera.width, self.camera.height)), self._reach + 1
        if (radii > self._limit * z).any():  # the lens model may project such points anywhere
            return (-known, -known, *(size + known).tolist())
        uv = self.camera.project(points)
        low = np.floor(uv.min(0)).astype(int) - self._reach
        high = np.ceil(uv.max(0)).astype(int) + self._reach + 1
        if (high <= 0).any() or (low >= size).any():
            return None
        return (*np.maximum(low, -known).tolist(), *np.minimum(high, size + known).tolist())

    def _trace(self, disc: Disc | RollingDisc, box: tuple[int, int, int, int]) -> Picture:
        """(h, w, 2) of a box: the card's share of each pixel and the light from that share, both blurred."""
        u0, v0, u1, v1 = box
        m = self._margin - 1  # one more pixel on each side for the gradient
        rays = self._rays[v0 + m : v1 + m + 2, u0 + m : u1 + m + 2]
        fine = cv2.resize(rays, None, fx=SUBSAMPLES, fy=SUBSAMPLES, interpolation=cv2.INTER_LINEAR)
        # All sub-samples of a pixel have the time of its row.
        rows = np.arange(v0 - 1, v1 + 1).repeat(SUBSAMPLES)
        heights = self.camera.image_row(np.column_stack([rows, rows]))
        rim = SUBSAMPLES - 1
        points = disc.intersect(np.asarray(fine, np.float32), heights)[rim:-rim, rim:-rim]
        radius = np.asarray(cv2.magnitude(points[..., 0], points[..., 1]), np.float32)
        card, black, white = covered_shares(radius, disc.radii)
        if disc.code:
            black = black + _code_share(disc, points, radius)
        layers = cv2.merge([card, WHITE * card - (WHITE - BLACK) * (black - white)])
        blurred = cv2.GaussianBlur(
            layers, (0, 0), self.camera.blur_px * SUBSAMPLES, borderType=cv2.BORDER_CONSTANT
        )
        return np.asarray(cv2.resize(blurred, (u1 - u0, v1 - v0), interpolation=cv2.INTER_AREA), np.float32)

    def _draw_noise(self) -> Picture:
        shape = (self.camera.height + NOISE_SHIFTS, self.camera.width + NOISE_SHIFTS)
        noise = np.random.default_rng(self._seed).standard_normal(shape, np.float32)
        return noise * np.float32(self.camera.noise if self.camera.sensor == "clean" else 1)


class Renderer:
    """Renders the images of one camera of a scene."""

    def __init__(self, scene: Scene, name: str) -> None:
        """Raises ConfigError where the scene has no camera `name`."""
        self.scene, self.camera = scene, scene.camera(name)
        self._T_cam_world = invert(self.camera.T_world_cam)
        self._model = ImageModel(self.camera, zlib.crc32(f"{scene.seed} {name}".encode()))
        floor = paint_floor(scene.seed) if scene.clutter else plain_floor()
        self._backdrop = self._model.view(floor, self.camera.T_world_cam)

    def render(self, t_s: float, frame: int = 0) -> Grey:
        """Render the image (h, w), uint8, of an exposure with its middle at `t_s`; `frame` seeds its noise."""
        image = self._backdrop.copy()
        for samples in self._visible_discs(t_s):
            self._model.paint(image, samples)
        return self._model.expose(image, frame)

    def _visible_discs(self, t_s: float) -> list[list[Disc | RollingDisc]]:
        """The roundels that face the camera, farthest first, each as its discs at all sample times of the exposure."""
        camera = self.camera
        n, exposure_s, readout_s = camera.motion_samples, camera.exposure_us * 1e-6, camera.readout_us * 1e-6
        times = [t_s + ((k + 0.5) / n - 0.5) * exposure_s for k in range(n)]
        samples = [discs_while_read(self._discs_at, t, readout_s) for t in times]
        middle = {key: disc for key, disc in samples[n // 2].items() if disc.faces_camera}
        farthest_first = sorted(middle, key=lambda key: -middle[key].distance_m)
        return [[discs.get(key, middle[key]) for discs in samples] for key in farthest_first]

    def _discs_at(self, t_s: float) -> Mapping[tuple[str, int], Disc]:
        """Every roundel in the arena, by the name of its body and its number."""
        bodies = self.scene.bodies_at(t_s).items()
        discs = ((name, place_discs(body, self._T_cam_world @ T)) for name, (body, T) in bodies)
        return {(name, k): disc for name, own in discs for k, disc in enumerate(own)}


def covered_shares(radius: Picture, radii: tuple[float, ...]) -> list[Picture]:
    """The share of each cell (h, w) that lies within each of the radii.

    Across an edge, the share falls from 1 to 0 over one cell along the steeper axis. The shares of the cells in a
    column (or row) then sum to the position at which the edge crosses its middle, for any direction of the edge.

    Args:
        radius: (h + 2, w + 2) distances of the cells' centres from the disc's centre, with one more cell on each side.
        radii: the radii, in the unit of `radius`.
    """
    across = cv2.absdiff(radius[1:-1, 2:], radius[1:-1, :-2])
    down = cv2.absdiff(radius[2:, 1:-1], radius[:-2, 1:-1])
    cell = cv2.max(across, down) / 2 + np.float32(1e-9)
    middle = radius[1:-1, 1:-1]
    return [(0.5 + (np.float32(r) - middle) / cell).clip(0, 1) for r in radii]


def _code_share(disc: Disc | RollingDisc, points: Picture, radius: Picture) -> Picture:
    """The share of each cell (h, w) that black sectors of a disc's code cover; arguments as of `covered_shares`."""
    outer = disc.radii[1]
    inside, around = covered_shares(radius, (codes.INNER * outer, codes.OUTER * outer))
    x, y = cv2.split(points[1:-1, 1:-1])
    across = cv2.absdiff(radius[1:-1, 2:], radius[1:-1, :-2])
    down = cv2.absdiff(radius[2:, 1:-1], radius[:-2, 1:-1])
    width = cv2.magnitude(across, down) / 2 / np.maximum(radius[1:-1, 1:-1], codes.INNER * outer)
    black = codes.black_share(disc.code, np.arctan2(y, x), width)
    return np.asarray((around - inside) * black, np.float32)


def map_rays(lens: Lens, margin: int) -> Picture:
    """(h + 2 margin, w + 2 margin, 2): x/z and y/z of the rays of all pixels and of `margin` pixels around the image.

    Rays of pixels without an inverse of the distortion are set to 1000, which is outside every image.
    """
    u, v = np.arange(-margin, lens.width + margin), np.arange(-margin, lens.height + margin)
    rays = lens.normalise(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    return np.nan_to_num(rays, nan=1e3).reshape(len(v), len(u), 2).astype(np.float32)


def vignette(camera: SceneCamera) -> Picture:
    """The share of the light that reaches each pixel (h, w): 100 % at the centre."""
    return camera.sensor_model.falloff((camera.height, camera.width)).astype(np.float32)
