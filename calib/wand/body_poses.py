# SPDX-License-Identifier: BSD-3-Clause
"""Poses of the wand as a rigid body, and of cameras by it: cameras are joined that see other sides of it.

One view of four markers or more gives the body's pose in that camera (PnP: Terzakis and Lourakis 2020; Collins and
Bartoli 2014 for coplanar markers, which have two solutions). The views of several placed cameras at one instant, of
whatever markers, give one pose: the solution of one view that fits all of them best, adjusted to all. The markers are
then points of known position, and a further camera is placed by its images of them at all instants together, robustly
(RANSAC), then by least squares. Of an instant that only one camera saw, both solutions count: those of other instants
decide. Markers on a line give no pose. A camera that never saw the wand at the instant of another one is placed by the
wand's motion: its pose is extrapolated, at constant velocity, to the frame that saw it soonest before or after the
others did.

Relative poses of pairs of cameras are not averaged: the pose of a small part of the body is uncertain by degrees, and
its two solutions by tens of degrees, while an image of it is uncertain by a fraction of a pixel.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from calib.rig.camera import FLAT, MIN_MARKERS, NEAREST_M, solve_view, span_dimension, transform
from calib.rig.coverage import spread_evenly
from calib.rig.estimation import MARGIN, STEPS
from calib.wand.detections import MarkerTrack, WandDetections
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.foundation.columns import Columns
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, motion_from, rotation_from_vector, skew, vector_from_rotation

MAX_VIEW = 32  # of a view, that are used to locate it
SIGMA_RAD = 1.5e-3  # of a ray to a marker by a rough rig: 3 px of a lens of 2000 px
# Of a ray to a marker whose place the motion gives: a hand's 5 m/s^2 move it by 10 mm, 2 m away, in 60 ms.
MOVING_RAD = 5e-3
GATE = 5  # sigmas: a ray farther from its marker is an outlier
TOLERANCE = 0.01  # the least gain of the cost in a step
SWEEPS = 3  # in which all cameras are located in turn by the body
FRAMES = 200  # of a camera, that place it
TRIALS = 1000  # of RANSAC
REFINED = 4  # best starts that are adjusted
# Inliers among the images of a camera; of one with few frames, in which a wrong pose fits half by chance.
MIN_SHARE, MIN_SHARE_OF_FEW, FEW_FRAMES = 0.5, 0.8, 8
NO_FIT = (
    "its images do not fit the wand as the others see it; check its name, its clock, its intrinsics, and that its "
    "image is not mirrored"
)
DETECTION_PX = 0.3  # noise of a detection, where two poses of a camera are compared


@dataclass(frozen=True, slots=True, eq=False)
class _Views(Columns):
    """Images of markers by placed cameras, at several instants.

    Attributes:
        instant, camera, marker: (n,) numbers, sorted in this order.
        xy: (n, 2) image plane coordinates.
    """

    instant: Index
    camera: Index
    marker: Index
    xy: Array


@dataclass(frozen=True, slots=True)
class PlacedCamera:
    """A camera that was placed by the body: its pose in the world, the frames and the share of its images that fit."""

    T: Array
    frames: int
    share: float


def has_poses(wand: Body) -> bool:
    """Whether the markers give the pose of the body: four or more that are not on a line."""
    return len(wand.markers) >= MIN_MARKERS and span_dimension(wand.points) >= 2


class BodyLocator:
    """Locates the wand by the cameras of a rough rig.

    Args:
        tracks: by camera and marker, by stamps.
        points: (M, 3) markers of the wand.
        poses: (4, 4) T_world_cam by camera.
        offset_s: true time = stamp + offset, by camera.
        gap_s: longest time over which tracks are interpolated.
        solved: poses of the wand in single views that are known already, to which more are added.
    """

    def __init__(
        self,
        tracks: Sequence[Sequence[MarkerTrack]],
        points: Array,
        poses: dict[int, Array],
        offset_s: dict[int, float],
        gap_s: float,
        solved: dict[tuple[int, bytes], list[Array]] | None = None,
    ) -> None:
        self.tracks, self.points, self.gap_s = tracks, points, gap_s
        self.poses, self.offset_s = poses, offset_s
        self.located: dict[float, list[Array]] = {}
        self.solved = {} if solved is None else solved
        self.inverse = np.zeros((len(tracks), 4, 4))
        for k, T in poses.items():
            self.inverse[k] = invert(T)

    def locate(self, t_s: Array) -> list[list[Array]]:
        """The poses T_world_wand (4, 4) that the cameras allow at each of the true times (K,): none, one, or two."""
        times = t_s.tolist()
        if new := sorted(set(times) - set(self.located)):
            self.located |= dict(zip(new, self._locate(np.array(new)), strict=True))
        return [self.located[t] for t in times]

    def _locate(self, t_s: Array) -> list[list[Array]]:
        views, allowed = self._views(t_s), [list[Array]() for _ in t_s]
        if not len(views.instant):
            return allowed
        candidates, instant = self._solve(views)
        if not len(candidates):
            return allowed
        rows, owner = _repeat(views.instant, instant)
        chosen = _best(self._costs(candidates, views.select(rows), owner), instant, REFINED)
        candidates, instant = candidates[chosen], instant[chosen]
        rows, owner = _repeat(views.instant, instant)
        poses, costs = self._refine(candidates, views.select(rows), owner)
        least = np.full(len(t_s), np.inf)
        for c in np.lexsort((costs, instant)).tolist():
            k, found = instant[c], allowed[instant[c]]
            if not found or (
                len(found) == 1 and costs[c] < least[k] + MARGIN and _differ(poses[c], found[0], self.points)
            ):
                found.append(poses[c])
            least[k] = min(least[k], costs[c])
        return allowed

    def locate_by_motion(self, t_s: Array) -> Array:
        """Locate the wand at those of the times (K,), at which no camera sees it, that are next to a frame of a placed
        camera, and near enough that the motion about that frame gives the pose; `locate` knows it from now on.

        Returns:
            these times.
        """
        if not len(t_s):
            return t_s
        seen = self._seen_s()
        nearest: dict[
            tuple[int, bool], float
        ] = {}  # by the number of the frame, and whether that is before the time
        for t in t_s.tolist():
            after = int(np.searchsorted(seen, t))
            for k in range(max(after - 1, 0), min(after + 1, len(seen))):
                name, apart = (k, bool(seen[k] < t)), abs(t - seen[k])
                if apart <= self.gap_s and (name not in nearest or apart < abs(nearest[name] - seen[k])):
                    nearest[name] = t
        for (k, is_before), t in nearest.items():
            first = np.searchsorted(seen, seen[k] - self.gap_s)
            last = np.searchsorted(seen, seen[k] + self.gap_s, "right") - 1
            if (far := int(first if is_before else last)) != k:
                self.located[t] = self._extrapolate(float(seen[far]), float(seen[k]), t)
        return np.array(sorted({t for t in nearest.values() if self.located.get(t)}))

    def _seen_s(self) -> Array:
        """The true times, ascending, of the frames in which placed cameras saw the wand."""
        times = [track.t_s + self.offset_s[k] for k in self.poses for track in self.tracks[k]]
        return np.unique(np.concatenate(times))

    def _extrapolate(self, start: float, end: float, t: float) -> list[Array]:
        """The poses T_world_wand at time t by constant velocity from `start` to `end`: of each pose at the end, from
        the nearest one at the start."""
        first, last = self.locate(np.array([start, end]))
        share, poses = (t - end) / (end - start), []
        for T in last if first else []:
            apart = [
                np.linalg.norm(transform(other, self.points) - transform(T, self.points)) for other in first
            ]
            before = first[int(np.argmin(apart))]
            turn = vector_from_rotation(T[:3, :3] @ before[:3, :3].T)
            moved = T.copy()
            moved[:3, :3] = rotation_from_vector(share * turn) @ T[:3, :3]
            moved[:3, 3] += share * (T[:3, 3] - before[:3, 3])
            poses.append(moved)
        return poses

    def sees(self, t_s: Array) -> Mask:
        """(K,) whether a camera sees a marker at the times (K,)."""
        return np.bincount(self._views(t_s).instant, minlength=len(t_s)) > 0

    def _views(self, t_s: Array) -> _Views:
        parts = []
        for k in sorted(self.poses):
            xy = np.array([track.interpolate(t_s - self.offset_s[k], self.gap_s) for track in self.tracks[k]])
            marker, instant = _thin(*np.nonzero(np.isfinite(xy[..., 0])))
            parts.append(_Views(instant, np.full(len(marker), k), marker, xy[marker, instant]))
        views = parts[0].joined(*parts[1:])
        return views.select(np.lexsort((views.marker, views.camera, views.instant)))

    def _solve(self, views: _Views) -> tuple[Array, Index]:
        """(P, 4, 4) T_world_wand by single views, and (P,) their instants."""
        key = views.instant * (max(self.poses) + 1) + views.camera
        first = np.flatnonzero(np.diff(key, prepend=-1))
        poses, instants = [np.zeros((0, 4, 4))], []
        for a, b in zip(first.tolist(), [*first[1:].tolist(), len(key)], strict=True):
            name = (int(views.camera[a]), views.xy[a:b].tobytes())
            if name not in self.solved:
                self.solved[name] = solve_view(self.points[views.marker[a:b]], views.xy[a:b])
            for T in self.solved[name]:
                poses.append((self.poses[views.camera[a]] @ T)[None])
                instants.append(views.instant[a])
        return np.concatenate(poses), np.array(instants, np.intp)

    def _costs(self, poses: Array, views: _Views, owner: Index) -> Array:
        """(P,) Cauchy's cost of poses (P, 4, 4): twice the negative log likelihood of their images, which have the pose
        `owner` (n,)."""
        error = views.xy - self._project(poses, views, owner)[1]
        cost = 2 * np.log1p((error**2).sum(axis=1) / SIGMA_RAD**2 / 2)
        return np.asarray(np.bincount(owner, cost, len(poses)), float)

    def _project(self, poses: Array, views: _Views, owner: Index) -> tuple[Array, Array]:
        """(n, 3) the markers in the cameras' frames, and (n, 2) their image plane coordinates."""
        motions = (self.inverse[:, None] @ poses[None])[views.camera, owner]
        p = (motions[:, :3, :3] @ self.points[views.marker][..., None])[..., 0] + motions[:, :3, 3]
        p[:, 2] = np.where(p[:, 2] > NEAREST_M, p[:, 2], NEAREST_M)  # behind the camera too
        return p, p[:, :2] / p[:, 2:]

    def _residuals(self, poses: Array, views: _Views, owner: Index) -> tuple[Array, Array]:
        """(n, 2) residuals in the image plane, and (n, 2, 6) their derivatives by a turn about the body's place and a
        shift in the world."""
        p, xy = self._project(poses, views, owner)
        turned = (poses[owner, :3, :3] @ self.points[views.marker][..., None])[..., 0]
        projection = np.zeros((len(p), 2, 3))
        projection[:, 0, 0] = projection[:, 1, 1] = 1 / p[:, 2]
        projection[:, :, 2] = -xy / p[:, 2:]
        by_point = projection @ self.inverse[views.camera, :3, :3]
        return views.xy - xy, np.concatenate([-by_point @ skew(turned), by_point], axis=2)

    def _refine(self, poses: Array, views: _Views, owner: Index) -> tuple[Array, Array]:
        """Poses (P, 4, 4) adjusted to their images by reweighted Gauss-Newton, and their costs (P,)."""
        best, least = poses, self._costs(poses, views, owner)
        for _ in range(STEPS):
            residuals, J = self._residuals(best, views, owner)
            weight = 1 / (1 + (np.linalg.norm(residuals, axis=1) / SIGMA_RAD) ** 2 / 2)
            first = np.searchsorted(owner, np.arange(len(best)))
            weighted = np.swapaxes(J, 1, 2) * weight[:, None, None]
            A = np.add.reduceat(weighted @ J, first)
            b = np.add.reduceat(weighted @ residuals[..., None], first)
            step = np.linalg.solve(A + 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(6), b)
            moved = best.copy()
            moved[:, :3, :3] = rotation_from_vector(step[:, :3, 0]) @ best[:, :3, :3]
            moved[:, :3, 3] += step[:, 3:, 0]
            costs = self._costs(moved, views, owner)
            better = costs < least
            if not (costs < least - TOLERANCE).any():
                break
            best, least = np.where(better[:, None, None], moved, best), np.where(better, costs, least)
        return best, least


def _thin(marker: Index, instant: Index) -> tuple[Index, Index]:
    """Markers (n,) and their instants (n,), of each instant at most `MAX_VIEW`, evenly."""
    order = np.lexsort((marker, instant))
    marker, instant = marker[order], instant[order]
    first = np.flatnonzero(np.diff(instant, prepend=-1))
    count = np.repeat(np.diff(first, append=len(instant)), np.diff(first, append=len(instant)))
    rank = np.arange(len(instant)) - np.repeat(first, np.diff(first, append=len(instant)))
    kept = (rank * MAX_VIEW // np.maximum(count, MAX_VIEW)) != (
        (rank - 1) * MAX_VIEW // np.maximum(count, MAX_VIEW)
    )
    return marker[kept], instant[kept]


def _repeat(of_row: Index, of_pose: Index) -> tuple[Index, Index]:
    """The rows (n,) that belong to each pose, whose numbers `of_row` (ascending) are those `of_pose` (P,), and their
    pose (n,)."""
    first, last = (np.searchsorted(of_row, of_pose, side=side) for side in ("left", "right"))
    owner = np.repeat(np.arange(len(of_pose)), last - first)
    start = np.repeat(np.cumsum(last - first) - (last - first), last - first)
    return np.arange(len(owner)) - start + first[owner], owner


def _best(costs: Array, group: Index, most: int) -> Index:
    """Indices of the up to `most` least costs (n,) of each group (n,)."""
    order = np.lexsort((costs, group))
    first = np.flatnonzero(np.diff(group[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(first, np.diff(first, append=len(order)))
    return order[rank < most]


def _differ(a: Array, b: Array, points: Array) -> bool:
    """Whether two poses of a body place its points (n, 3) differently."""
    apart = np.linalg.norm(transform(a, points) - transform(b, points), axis=1).max()
    return bool(apart > FLAT * np.ptp(points, axis=0).max())


@dataclass(frozen=True, slots=True)
class BodyPlacement:
    """Places cameras by the pose of the wand.

    Attributes:
        tracks: by camera and marker, by stamps.
        detections: labeled.
        lenses: by camera.
        wand: with markers that give poses (`has_poses`).
        gap_s: longest time over which tracks are interpolated.
        solved: poses of the wand in single views.
    """

    tracks: Sequence[Sequence[MarkerTrack]]
    detections: WandDetections
    lenses: Sequence[Lens]
    wand: Body
    gap_s: float
    solved: dict[tuple[int, bytes], list[Array]] = field(default_factory=dict)

    def extend(
        self, cameras: Sequence[int], poses: dict[int, Array], offset_s: dict[int, float]
    ) -> tuple[dict[int, Array], dict[int, float], dict[int, str]]:
        """Place further cameras one after the other, those with most frames first.

        Args:
            cameras: all that may be placed.
            poses: T_world_cam of those that are placed; without any, the camera with most views is the world.
            offset_s: their time offsets; those of cameras that are placed here are 0.

        Returns:
            poses and time offsets with the cameras that could be placed, and why each other one could not.
        """
        views = {k: self.detections.select(self.detections.camera == k) for k in cameras}
        poses, offset_s = dict(poses), dict(offset_s)
        if not poses:
            first = max(cameras, key=lambda k: (_count_views(views[k]), -k))
            poses, offset_s = {first: np.eye(4)}, {first: 0.0}
        swept, reasons = False, {}
        while waiting := [k for k in cameras if k not in poses and len(views[k])]:
            locator = self._locator(poses, offset_s)
            found = {k: _place(locator, views[k], self.lenses[k]) for k in waiting}
            placed = {k: camera for k, camera in found.items() if isinstance(camera, PlacedCamera)}
            reasons = {k: why for k, why in found.items() if isinstance(why, str)}
            if not placed and swept:
                break
            if placed:
                best = max(placed, key=lambda k: (placed[k].frames, placed[k].share, -k))
                poses[best], offset_s[best] = placed[best].T, 0.0
            else:
                poses = self._sweep(poses, offset_s, views)
            swept = not placed
        return (poses if swept else self._sweep(poses, offset_s, views)), offset_s, reasons

    def _locator(self, poses: dict[int, Array], offset_s: dict[int, float]) -> "BodyLocator":
        return BodyLocator(self.tracks, self.wand.points, poses, offset_s, self.gap_s, self.solved)

    def _sweep(
        self, poses: dict[int, Array], offset_s: dict[int, float], views: dict[int, WandDetections]
    ) -> dict[int, Array]:
        """The poses of the cameras by the body, and of the body by the cameras, in turn."""
        for _ in range(SWEEPS if len(poses) > 2 else 0):
            locator = self._locator(poses, offset_s)
            again = {k: _place(locator, views[k], self.lenses[k], poses[k]) for k in poses}
            poses = {k: T if isinstance(by := again[k], str) else by.T for k, T in poses.items()}
        return poses


def _count_views(detections: WandDetections) -> int:
    """The number of frames that give the body's pose by themselves."""
    return int((np.unique(detections.frame, return_counts=True)[1] >= MIN_MARKERS).sum())


@dataclass(frozen=True, slots=True)
class _Images:
    """Images of points of known position by the camera that is placed.

    Attributes:
        points: (n, 3) world. A detection occurs once for each pose that the body may have in its frame.
        xy: (n, 2) image plane coordinates.
        pose, frame: (n,) numbers of the body's pose, ascending, and of the frame.
        sigma: (n,) standard deviation of the ray to the point, rad.
        frame_of_pose: (P,).
    """

    points: Array
    xy: Array
    pose: Index
    frame: Index
    sigma: Array
    frame_of_pose: Index

    def errors(self, T_cam_world: Array) -> Array:
        """(n,) distances in the image plane; infinite behind the camera."""
        p = transform(T_cam_world, self.points)
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.linalg.norm(p[:, :2] / p[:, 2:] - self.xy, axis=1)
        return np.where(p[:, 2] > 0, error, np.inf)

    def fits(self, T_cam_world: Array) -> Mask:
        """(n,) the images near their points."""
        return self.errors(T_cam_world) < GATE * self.sigma

    def choose(self, T_cam_world: Array, sigma: Array | float) -> tuple[float, Mask]:
        """Cauchy's cost by these standard deviations, with the pose of the body in each frame that fits best, and (n,)
        the images of these poses."""
        cost = np.log1p(np.minimum(self.errors(T_cam_world) / sigma, 1e6) ** 2 / 2)
        by_pose = np.bincount(self.pose, 2 * cost, len(self.frame_of_pose))
        order = np.lexsort((by_pose, self.frame_of_pose))
        best = order[np.diff(self.frame_of_pose[order], prepend=-1) != 0]
        return float(by_pose[best].sum()), np.isin(self.pose, best)


def _place(
    locator: BodyLocator, detections: WandDetections, lens: Lens, start: Array | None = None
) -> PlacedCamera | str:
    """Place the camera of these detections by the body, whose poses the locator gives, near the pose `start` if there
    is one; the reason where its images do not fit or do not determine it."""
    images = _collect(locator, detections)
    if images is None:
        return (
            "no other camera that is placed saw four markers of the wand when it did, or just before or after; show "
            "them the wand at once, each any side of the wand"
        )
    if len(images.points) < MIN_MARKERS or span_dimension(images.points) < 2:
        return (
            "it saw too few markers with the others to be placed; show it any side of the wand in more frames"
        )
    starts = list(_starts(images)) if start is None else [invert(start)]
    # Of one pose of the body, an error moves the camera with it, and only noise remains; of several, errors differ.
    single = len(np.unique(images.frame)) == 1
    sigma = 2 * DETECTION_PX / (lens.fx + lens.fy) if single else images.sigma
    starts = sorted(starts, key=lambda T: images.choose(T, images.sigma)[0])[:REFINED]
    refined = [T for T in (_refine_camera(images, T, sigma) for T in starts) if T is not None]
    if not refined:
        return NO_FIT
    T = min(refined, key=lambda T: images.choose(T, sigma)[0])
    least, chosen = images.choose(T, sigma)
    apart = np.vstack([np.zeros(3), np.eye(3)]) * np.ptp(images.points, axis=0).max()
    rivals = [other for other in refined if _differ(invert(other), invert(T), apart)]
    if any(images.choose(other, sigma)[0] < least + MARGIN for other in rivals):
        return (
            f"its {len(np.unique(images.frame))} frames with the wand allow two poses, because their markers are "
            "nearly in one plane; show it another side of the wand, or the same one more slanted"
        )
    inlier = chosen & images.fits(T)
    frames, share = len(np.unique(images.frame[inlier])), inlier.sum() / chosen.sum()
    if inlier.sum() < MIN_MARKERS or share < (MIN_SHARE if frames >= FEW_FRAMES else MIN_SHARE_OF_FEW):
        return NO_FIT
    return PlacedCamera(invert(T), frames, float(share))


def _collect(locator: BodyLocator, detections: WandDetections) -> _Images | None:
    """The images in up to `FRAMES` frames in which the locator knows the body's pose, if these are few by its motion
    too; None without any."""
    every = np.unique(detections.t_s)
    is_seen = locator.sees(every)
    seen = every[is_seen]
    moving = locator.locate_by_motion(every[~is_seen]) if len(seen) < FEW_FRAMES else seen[:0]
    times = np.union1d(seen, moving)
    times = times[spread_evenly(len(times), FRAMES)]
    points, rows, pose, frame_of_pose = [], [], [], []
    for frame, (t, allowed) in enumerate(zip(times.tolist(), locator.locate(times), strict=True)):
        mine = np.flatnonzero(detections.t_s == t)
        for T in allowed:
            points.append(transform(T, locator.points[detections.label[mine]]))
            rows.append(mine)
            pose.append(np.full(len(mine), len(frame_of_pose)))
            frame_of_pose.append(frame)
    if not rows:
        return None
    number, poses, row = np.array(frame_of_pose), np.concatenate(pose), np.concatenate(rows)
    sigma = np.where(np.isin(detections.t_s[row], moving), MOVING_RAD, SIGMA_RAD)
    return _Images(np.concatenate(points), detections.xy[row], poses, number[poses], sigma, number)


def _starts(images: _Images) -> Iterator[Array]:
    """Poses T_cam_world by RANSAC of all images, and by single views of the body."""
    if (T := _ransac(images)) is not None:
        yield T
    poses = np.unique(images.pose)
    for pose in poses[spread_evenly(len(poses), FRAMES // 16)]:
        mine = images.pose == pose
        yield from solve_view(images.points[mine], images.xy[mine])


def _ransac(images: _Images) -> Array | None:
    """T_cam_world that most images fit; None where none is found."""
    cv2.setRNGSeed(0)
    options = {
        "iterationsCount": TRIALS,
        "reprojectionError": GATE * images.sigma.max(),
        "confidence": 0.9999,
    }
    try:
        found, turn, shift, _ = cv2.solvePnPRansac(
            images.points, images.xy, np.eye(3), None, **options, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return None
    return motion_from(turn, shift) if found else None


def _refine_camera(images: _Images, T: Array, sigma: Array | float) -> Array | None:
    """The pose adjusted to the images near its own; None where these are too few."""
    for _ in range(SWEEPS):
        inlier = images.choose(T, sigma)[1] & images.fits(T)
        if inlier.sum() < MIN_MARKERS or span_dimension(images.points[inlier]) < 2:
            return None
        turn, shift = cv2.solvePnPRefineLM(
            images.points[inlier],
            images.xy[inlier],
            np.eye(3),
            None,
            cv2.Rodrigues(T[:3, :3])[0],
            T[:3, 3:].copy(),
        )
        T = motion_from(turn, shift)
    return T if np.isfinite(T).all() else None
