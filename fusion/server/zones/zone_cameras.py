# SPDX-License-Identifier: BSD-3-Clause
"""Which zone uses which camera, and how well each zone's own cameras see a place; by the rig's geometry alone.

Every zone computes the same from the same rig, so they agree without a message. A point is seen by a camera if it
projects into the image and a roundel there is large enough for the detector.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from calib.rig.camera import Camera
from camera_node.foundation.arrays import Array, Mask
from camera_node.sensor_model.operational_space import farthest_distance
from camera_node.sensor_model.threshold import MIN_DIAMETER_PX
from camera_node.sensor_model.visibility import reach, within_reach

SAMPLES = 9  # of a camera's view along each side and in depth: an overlap of an eighth of it is found


class ZoneCameras:
    """The cameras of a rig and their zones.

    Args:
        cameras: the placed ones, by name.
        zones: the names of each zone's own cameras, in the order of the arena's zones.
        diameter_m: of the largest roundels of the robots.

    Attributes:
        zones: as given.
    """

    def __init__(
        self, cameras: Mapping[str, Camera], zones: Mapping[str, tuple[str, ...]], diameter_m: float
    ) -> None:
        self.zones = dict(zones)
        self._views = {name: _View.of(camera, diameter_m) for name, camera in cameras.items()}
        self._overlaps = self._find_overlaps()

    def own(self, living: Collection[str]) -> dict[str, set[str]]:
        """The cameras of each living zone: its own ones, and those of no living zone that overlap with them most."""
        own = {zone: set(names) for zone, names in self.zones.items() if zone in living}
        free = self._views.keys() - set().union(*own.values())
        adopted = free
        while adopted and own:  # from the borders of the living zones inwards
            best = {
                camera: max((self._overlap(camera, cameras), zone) for zone, cameras in own.items())
                for camera in free
            }
            adopted = {camera for camera, (overlap, _) in best.items() if overlap}
            for camera in adopted:
                own[best[camera][1]].add(camera)
            free -= adopted
        if own:
            own[next(iter(own))] |= free
        return own

    def used(self, own: Collection[str]) -> set[str]:
        """A zone's own cameras, and those of others that see places that its own ones see."""
        return set(own) | {camera for camera in self._views if self._overlap(camera, own)}

    def look_at(self, points: Array) -> "SeenPlaces":
        """How all cameras see places (N, 3), world."""
        information = {}
        for name in self._near(points):
            of_camera = self._views[name].information(points)
            if of_camera.any():
                information[name] = of_camera
        return SeenPlaces(len(points), information)

    def _near(self, points: Array) -> list[str]:
        """The cameras within whose range and angle some of the points (N, 3) are."""
        views = list(self._views.values())
        if not views:
            return []
        local = (points - np.array([view.centre for view in views])[:, None]) @ np.array(
            [v.R.T for v in views]
        )
        tangent, range_m = np.array([(view.tangent, view.range_m) for view in views]).T[:, :, None]
        near = (within_reach(local, tangent) & (local[:, :, 2] < range_m)).any(axis=1)
        return [name for name, is_near in zip(self._views, near, strict=True) if is_near]

    def _overlap(self, camera: str, others: Collection[str]) -> int:
        """How many sampled points a camera shares with others."""
        return sum(self._overlaps.get((camera, other), 0) for other in others if other != camera)

    def _find_overlaps(self) -> dict[tuple[str, str], int]:
        """Of all pairs of cameras the number of points that both see, symmetric."""
        floored = all(
            view.centre[2] > 0 for view in self._views.values()
        )  # z is up, and the world's origin below
        samples = {name: view.samples(floored) for name, view in self._views.items()}
        counts: dict[tuple[str, str], int] = {}
        for one, points in samples.items():
            for other, view in self._views.items():
                if one != other and view.is_near(self._views[one]):
                    count = int(view.sees(points).sum())
                    for pair in ((one, other), (other, one)):
                        counts[pair] = counts.get(pair, 0) + count
        return counts


@dataclass(frozen=True, slots=True, eq=False)
class SeenPlaces:
    """How cameras see N places.

    Attributes:
        n: N.
        information: of the cameras that see some of them (N, 3, 3) by the centre and the size of a roundel's image,
            m^-2 for an error of 1 px; zero for places that the camera does not see.
    """

    n: int
    information: dict[str, Array]

    def by(self, cameras: Collection[str]) -> Mask:
        """(N,) the places that one of the cameras sees."""
        return _are_seen(self._sum(cameras))

    def variances(self, cameras: Collection[str]) -> Array:
        """(N,) expected variances of positions by the cameras that see them, m^2 for an error of 1 px; infinite where
        none does."""
        information = self._sum(cameras)
        seen = _are_seen(information)
        variances = np.full(self.n, np.inf)
        variances[seen] = np.trace(np.linalg.inv(information[seen]), axis1=1, axis2=2)
        return variances

    def _sum(self, cameras: Collection[str]) -> Array:
        """(N, 3, 3) of these cameras together."""
        of_these = [of_camera for name, of_camera in self.information.items() if name in cameras]
        return sum(of_these, np.zeros((self.n, 3, 3)))


def _are_seen(information: Array) -> Mask:
    """(N,) places of which there is information (N, 3, 3)."""
    return np.trace(information, axis1=1, axis2=2) > 0


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """What a placed camera sees.

    Attributes:
        camera: its lens.
        R, centre: from the world into the camera, and its place in the world.
        diameter_m: of a roundel.
        range_m: along the optical axis, at which that is too small for the detector.
        tangent: of the angle from the axis that the image's corners reach.
    """

    camera: Camera
    R: Array
    centre: Array
    diameter_m: float
    range_m: float
    tangent: float

    @classmethod
    def of(cls, camera: Camera, diameter_m: float) -> "_View":
        T = camera.matrix()
        range_m = farthest_distance(camera, diameter_m, MIN_DIAMETER_PX)
        return cls(camera, T[:3, :3].T, T[:3, 3], diameter_m, range_m, reach(camera))

    def is_near(self, other: "_View") -> bool:
        """Whether the spheres within their ranges intersect."""
        return bool(np.linalg.norm(self.centre - other.centre) < self.range_m + other.range_m)

    def sees(self, points: Array) -> Mask:
        """(N,) of points (N, 3), world."""
        local = (points - self.centre) @ self.R.T
        seen = within_reach(local, self.tangent) & (local[:, 2] < self.range_m)
        seen[seen] = self.camera.sees(self.camera.project(local[seen]))
        return seen

    def samples(self, floored: bool) -> Array:
        """(S, 3) points in its view, world; only those above the origin if `floored`."""
        u, v = (np.linspace(0.0, n - 1.0, SAMPLES) for n in (self.camera.width, self.camera.height))
        xy = self.camera.normalise(np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2))
        rays = np.column_stack([xy, np.ones(len(xy))])[np.isfinite(xy).all(axis=1)]
        depths = self.range_m * np.arange(1, SAMPLES + 1) / SAMPLES
        points = (depths[:, None, None] * rays).reshape(-1, 3) @ self.R + self.centre
        return points[points[:, 2] >= 0] if floored else points

    def information(self, points: Array) -> Array:
        """(N, 3, 3) of positions (N, 3), per px^2; zero where the camera does not see them."""
        information = np.zeros((len(points), 3, 3))
        seen = self.sees(points)
        local = (points[seen] - self.centre) @ self.R.T
        focal = (self.camera.fx + self.camera.fy) / 2
        _, J_centre = self.camera.project_with_jacobian(local)
        J_size = np.zeros((len(local), 1, 3))
        J_size[:, 0, 2] = -focal * self.diameter_m / local[:, 2] ** 2
        J = np.concatenate([J_centre, J_size], axis=1) @ self.R
        information[seen] = J.transpose(0, 2, 1) @ J
        return information
