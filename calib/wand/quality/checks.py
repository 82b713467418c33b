# SPDX-License-Identifier: BSD-3-Clause
"""Checks an adjustment against the recording and against the files that it was given.

Lenses, camera names and the wand's dimensions must be those of the files. Residuals of detections at a given rig, each
with its marker triangulated again (no motion prior, no wand length), show how well the rig describes detections that it
was not adjusted to.

Detections may be under the wrong camera: points of two cameras swapped, or of all rotated. Synchronous cameras: in
every instant that contradicts the rig, detections are tried under other cameras, for all swaps of two cameras and all
rotations of the cameras' order; the one under which all rays meet explains it. Other cameras: a detection that the
adjustment rejects, but that is where another camera sees the marker, is of that camera.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.special import chdtrc

from calib.errors import CalibrationError, CameraFault
from calib.rig.camera import LENS, lens_parameters
from calib.rig.estimation import CHANCE, CLEAR, GROSS, coordinate_sigma, rms
from calib.rig.triangulation import intersect_images
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.problem import Adjusted, State, WandObservations
from calib.wand.bundle_adjustment.residuals import point_jacobians, predict_markers
from calib.wand.detections import WandDetections, WandRecording, group_rows, interpolate, ranges
from calib.wand.wand_report import Exchange, Validation
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

# Of the distance, by sizes: what tone curves and dot gain leave of them; 2 % in the first seconds of a camera.
MAX_SIZE_ERROR = 0.04
MIN_MOTION = 0.02  # of an image's longer side, that the wand moves
GATE = 0.01  # of an image's longer side: a detection this near to the expected place is of that camera
CLEARLY = 0.25  # of this distance, that the rays of synchronous cameras pass each other at most, if exchanged rightly
MIN_SHARE, MIN_COUNT = 0.02, 8  # of a camera's detections, from which its points count as exchanged
MIN_CAMERAS = 3  # that saw a marker at once: the rays of two meet for many exchanges


def check_lenses(names: Sequence[str], adjusted: Adjusted) -> None:
    """Raise CameraFault where the lenses of two cameras are swapped."""
    lenses, cov = adjusted.problem.lenses, camera_covariance(adjusted).of(LENS)
    found = adjusted.state.corrected(lenses)
    for a, b in combinations(adjusted.problem.estimated_cameras(), 2):
        crossed = (
            _lens_distance(found[a], lenses[b], cov[a, :, a]),
            _lens_distance(found[b], lenses[a], cov[b, :, b]),
        )
        straight = (
            _lens_distance(found[a], lenses[a], cov[a, :, a]),
            _lens_distance(found[b], lenses[b], cov[b, :, b]),
        )
        if max(crossed) < min(CLEAR, min(straight) / 2) and _probability(min(straight)) < CHANCE:
            swapped = (
                "its detections fit the intrinsics of '{}', and vice versa; swap the two in the rig file"
            )
            raise CameraFault({names[a]: swapped.format(names[b]), names[b]: swapped.format(names[a])})


def _lens_distance(found: Lens, given: Lens, cov: Array) -> float:
    """Distance of two lenses in sigmas, root mean square of the adjusted parameters."""
    off = lens_parameters(found) - lens_parameters(given)
    return float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))


def _probability(distance: float) -> float:
    """Probability of a distance of two lenses in sigmas, root mean square, or of a larger one."""
    return float(chdtrc(len(LENS), len(LENS) * distance**2))


def check_motion(detections: WandDetections, names: Sequence[str], lenses: Sequence[Lens]) -> None:
    """Raise CalibrationError where no camera saw the wand move: a wand at rest determines little, and no clock."""
    moved, share = {}, {}
    for k, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        mine = np.flatnonzero(detections.camera == k)
        for rows in group_rows(detections.label[mine], int(detections.label.max(initial=-1)) + 1):
            if not len(rows):
                continue
            uv = detections.uv[mine[rows]]
            away = float(np.quantile(np.linalg.norm(uv - np.median(uv, axis=0), axis=1), 0.95))
            moved[name] = max(moved.get(name, 0.0), away)
            share[name] = moved[name] / max(lens.width, lens.height)
    if share and max(share.values()) < MIN_MOTION:
        name = max(moved, key=moved.__getitem__)
        raise CalibrationError(
            f"the wand hardly moved: by {moved[name]:.1f} px in the image of '{name}', and less in the others; wave it "
            "through the whole volume"
        )


def check_sizes(wand: Body, adjusted: Adjusted, observations: WandObservations) -> None:
    """Raise CalibrationError where the wand's lengths give other ranges of the roundels than their sizes do."""
    state, problem = adjusted.state, adjusted.problem
    if len(problem.wand.lengths) == 0:
        return
    lenses = state.corrected(problem.lenses)
    points = predict_markers(problem, observations, state).points
    by_lengths = np.linalg.norm(points - state.cameras[observations.camera, :3, 3], axis=1)
    ratio = ranges(lenses, observations, wand.diameter_m) / by_lengths
    known = np.isfinite(ratio) & adjusted.used
    if not known.any() or abs(np.log(factor := float(np.median(ratio[known])))) < MAX_SIZE_ERROR:
        return
    raise CalibrationError(
        f"the wand's lengths and its roundels' sizes disagree by {abs(factor - 1):.0%}: by the lengths, the black disc "
        f"is {wand.diameter_m / factor:.4f} m across, the wand file has {wand.diameter_m:.4f} m; measure both again"
    )


def triangulate_markers(adjusted: Adjusted, observations: WandObservations) -> Array:
    """(K, M, 3) positions of the wand's markers by the used observations alone, world; NaN where fewer than two cameras
    saw one, or their rays are parallel.

    One Gauss-Newton step of every marker of a frame set from its adjusted position, without the wand's lengths.
    """
    state, problem, rows = adjusted.state, adjusted.problem, np.flatnonzero(adjusted.used)
    markers = np.einsum("mb,kbx->kmx", problem.wand.displaced(state.shape).weights, state.motion[:, 0])
    camera, k, m = observations.camera[rows], observations.knot[rows], observations.label[rows]
    lenses = state.corrected(problem.lenses)
    J = np.nan_to_num(point_jacobians(lenses, state.cameras, camera, markers[k, m])[1])
    weight, residuals = np.linalg.inv(observations.cov[rows]), np.nan_to_num(adjusted.residuals[rows])
    A, b = np.zeros((*markers.shape, 3)), np.zeros(markers.shape)
    np.add.at(A, (k, m), np.swapaxes(J, 1, 2) @ weight @ J)
    np.add.at(b, (k, m), np.einsum("nji,njk,nk->ni", J, weight, residuals))
    views = np.zeros((*markers.shape[:2], len(problem.lenses)))
    views[k, m, camera] = 1
    observed = (views.sum(axis=2) >= 2) & (np.linalg.matrix_rank(A, hermitian=True) == 3)
    points = np.full(markers.shape, np.nan)
    points[observed] = markers[observed] + np.linalg.solve(A[observed], b[observed][:, :, None])[:, :, 0]
    return points


def measure_lengths(adjusted: Adjusted, observations: WandObservations) -> Array:
    """(n,) errors of the wand's lengths as the cameras alone measure them, metres."""
    wand = adjusted.problem.wand.displaced(adjusted.state.shape)
    markers = triangulate_markers(adjusted, observations)
    errors = _pair_distances(markers[:, wand.basis], wand.pairs) - wand.lengths
    return errors[np.isfinite(errors)]


def _pair_distances(points: Array, pairs: Index) -> Array:
    """(K, P) distances of P pairs of points (K, N, 3)."""
    ends = points[:, pairs]
    return np.asarray(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2), float)


@dataclass(frozen=True, slots=True)
class TriangulatedResiduals:
    """Residuals of n detections; NaN where fewer than two cameras saw the marker.

    Attributes:
        points: (n, 3) the markers, world.
        pixels: (n, 2) observed minus predicted pixels.
        range_m: (n,) distances of the markers from their cameras.
        focal_px: (n,) focal lengths of the cameras.
    """

    points: Array
    pixels: Array
    range_m: Array
    focal_px: Array

    def summary(self) -> Validation | None:
        """The residuals of all, and of those without gross errors; None where no two cameras saw a marker at once."""
        known = np.isfinite(self.pixels).all(axis=1)
        if not known.any():
            return None
        norms, distance = np.linalg.norm(self.pixels[known], axis=1), self.range_m[known]
        fine = norms <= GROSS * coordinate_sigma(norms)
        return Validation(
            count=len(norms),
            all_px=rms(norms),
            gross=float((~fine).mean()),
            residual_px=rms(norms[fine]),
            error_m=rms((norms / self.focal_px[known] * distance)[fine]),
            range_m=float(np.median(distance)),
        )


def triangulated_residuals(recording: WandRecording, state: State) -> TriangulatedResiduals:
    """Triangulate the marker of each detection, robustly, from it and from the other cameras' detections at its true
    time, equal or interpolated. Those whose stamps are too uncertain for that are left out (`WandRecording.timed`).

    Args:
        recording: labeled detections of C cameras.
        state: poses, clocks and lenses of these cameras.
    """
    lenses, timed = state.corrected(recording.lenses), recording.timed()
    recording = recording.select(timed).with_row_times(state.clocks[:, 2]).undistort_tracks(lenses)
    count = len(timed)
    points, pixels = np.full((count, 3), np.nan), np.full((count, 2), np.nan)
    range_m, focal_px = np.full(count, np.nan), np.empty(count)
    for camera, lens in enumerate(lenses):
        mine, T = np.flatnonzero(recording.detections.camera == camera), state.cameras[camera]
        rows = np.flatnonzero(timed)[mine]
        points[rows] = _triangulate_rows(recording, state, lens, camera, mine)
        away = points[rows] - T[:3, 3]
        pixels[rows] = recording.detections.uv[mine] - lens.project(away @ T[:3, :3])
        range_m[rows] = np.linalg.norm(away, axis=1)
        focal_px[rows] = (lens.fx + lens.fy) / 2
    return TriangulatedResiduals(points, pixels, range_m, focal_px)


def _triangulate_rows(recording: WandRecording, state: State, lens: Lens, camera: int, rows: Index) -> Array:
    """Return (r, 3) the markers of one camera's detections, world; NaN where no other camera saw them."""
    detections = recording.detections.select(rows)
    since = detections.t_s - recording.middle_s
    xy = np.full((len(recording.lenses), len(rows), 2), np.nan)
    for other, tracks in enumerate(recording.tracks):
        offset, drift = state.clocks[camera, :2] - state.clocks[other, :2]
        stamp_s = detections.t_s + offset + drift * since
        xy[other] = interpolate(tracks, detections.label, stamp_s, recording.timing.gap_s)
    xy[camera] = lens.normalise(detections.uv)
    return intersect_images(xy[:, None], state.cameras)[0][0]


def find_exchanges(
    recording: WandRecording, adjusted: Adjusted, observations: WandObservations
) -> tuple[list[Exchange], Mask]:
    """Find the detections of a recording that are under the wrong camera: who shows whose points, the most frequent
    first, where these are not few; and (n,) the detections that were tested and are under the right one."""
    count = len(recording.detections)
    tested, owner = np.zeros(count, bool), recording.detections.camera.copy()
    if recording.timing.synchronous:
        tested[:] = True
        rows, owners = _try_exchanges(recording, adjusted.state)
    else:
        tested[observations.row] = True
        rows, owners = _compare_with_motion(recording, adjusted, observations)
    owner[rows] = owners
    return _count_exchanges(recording, tested, owner), tested & (owner == recording.detections.camera)


def _count_exchanges(recording: WandRecording, tested: Mask, owner: Index) -> list[Exchange]:
    camera, names = recording.detections.camera, recording.names
    total = np.bincount(camera[tested], minlength=len(names))
    wrong = np.flatnonzero(owner != camera)
    counts = Counter(zip(camera[wrong].tolist(), owner[wrong].tolist(), strict=True))
    return [
        Exchange(str(names[shown]), str(names[of]), n / int(total[shown]))
        for (shown, of), n in counts.most_common()
        if n >= max(MIN_COUNT, MIN_SHARE * total[shown])
    ]


def _compare_with_motion(
    recording: WandRecording, adjusted: Adjusted, observations: WandObservations
) -> tuple[Index, Index]:
    """Rows (r,) of detections that are where another camera sees the marker, and (r,) that camera."""
    rejected, state = observations.select(~adjusted.used), adjusted.state
    if not len(rejected):
        return rejected.row, rejected.camera
    points = _interpolate_motion(adjusted, observations, rejected)
    # The other camera's frame is up to a period earlier or later: the marker is nearer than it moves in this time.
    inliers = predict_markers(adjusted.problem, observations.select(adjusted.used), state)
    speed = float(np.median(np.linalg.norm(inliers.velocity(adjusted.problem.knot_s), axis=1)))
    off, gate = np.empty((2, len(rejected), len(recording.names)))
    for camera, lens in enumerate(state.corrected(recording.lenses)):
        T = state.cameras[camera]
        off[:, camera] = _pixel_distances(lens, T, points, rejected.uv)
        moved_m = speed * recording.timing.period_s / np.linalg.norm(points - T[:3, 3], axis=1)
        gate[:, camera] = GATE * max(lens.width, lens.height) + lens.fx * moved_m
    every, own = np.arange(len(off)), rejected.camera
    contradicts = off[every, own] > gate[every, own]
    off[every, own] = np.inf
    best = (off / gate).argmin(axis=1)
    found = contradicts & (off[every, best] < gate[every, best])
    return rejected.row[found], best[found]


def _interpolate_motion(adjusted: Adjusted, observations: WandObservations, of: WandObservations) -> Array:
    """(n, 3) positions of observed markers, world, between the nearest knots that two cameras or more determine: where
    all detections of a frame set are wrong, its own knot is."""
    problem, used = adjusted.problem, adjusted.used
    wand = problem.wand.displaced(adjusted.state.shape)
    views = np.zeros((len(problem.knot_s), len(problem.lenses)), bool)
    views[observations.knot[used], observations.camera[used]] = True
    known = views.sum(axis=1) >= 2
    t_s = adjusted.state.true_times(of, problem.middle_s)
    positions = adjusted.state.motion[known, 0].reshape(int(known.sum()), -1)
    basis = np.column_stack([np.interp(t_s, problem.knot_s[known], column) for column in positions.T])
    return np.einsum("nb,nbx->nx", wand.weights[of.label], basis.reshape(len(t_s), -1, 3))


def _pixel_distances(lens: Lens, T: Array, points: Array, uv: Array) -> Array:
    """(n,) pixels between the images of points (n, 3), world, and uv (n, 2); infinite behind the camera."""
    return np.nan_to_num(
        np.linalg.norm(lens.project((points - T[:3, 3]) @ T[:3, :3]) - uv, axis=1), nan=np.inf
    )


def _try_exchanges(recording: WandRecording, state: State) -> tuple[Index, Index]:
    """Rows (r,) of detections whose rays meet those of the others only under another camera, and (r,) that camera."""
    table = _tabulate(recording)
    cameras = len(recording.lenses)
    table = table[(table >= 0).sum(axis=1) >= MIN_CAMERAS]
    own = _misfit(recording, state, table, np.arange(cameras))
    table = table[own > GATE]
    best, choice = np.full(len(table), np.inf), np.zeros(len(table), np.intp)
    orders = list(_orders(cameras))
    for k, order in enumerate(orders):
        misfit = _misfit(recording, state, table, order)
        choice[misfit < best] = k
        best = np.minimum(best, misfit)
    found = best < CLEARLY * GATE
    owners = np.array(orders)[choice[found]]
    rows = table[found]
    moved = (rows >= 0) & (owners != np.arange(cameras))
    return rows[moved], owners[moved]


def _orders(cameras: int) -> Iterator[Index]:
    """All swaps of two cameras, and all rotations of their order: (C,) whose detections each camera shows."""
    for a, b in combinations(range(cameras), 2):
        order = np.arange(cameras)
        order[[a, b]] = b, a
        yield order
    for shift in range(1, cameras):
        yield np.roll(np.arange(cameras), shift)


def _tabulate(recording: WandRecording) -> Index:
    """(K, C) the detection of each camera, by instant and marker; -1 where it has none."""
    detections = recording.detections
    instant = np.unique(detections.t_s, return_inverse=True)[1]
    key = instant * len(recording.wand.markers) + detections.label
    _, place = np.unique(key, return_inverse=True)
    table = np.full((int(place.max(initial=-1)) + 1, len(recording.lenses)), -1, np.intp)
    table[place, detections.camera] = np.arange(len(detections))
    return table


def _misfit(recording: WandRecording, state: State, table: Index, order: Index) -> Array:
    """(K,) largest distance of the detections of each row of a table (K, C) from the point where their rays meet, if
    camera k shows the detections of camera order[k]; relative to the images' longer sides."""
    cameras, lenses = len(order), state.corrected(recording.lenses)
    uv = recording.detections.uv
    pixels, xy = np.full((2, cameras, len(table), 2), np.nan)
    for shown in range(cameras):
        of, rows = int(order[shown]), table[:, shown]
        pixels[of] = np.where(rows[:, None] >= 0, uv[rows], np.nan)
        xy[of, rows >= 0] = lenses[of].normalise(pixels[of, rows >= 0])
    points, _, known = intersect_images(xy[:, None], state.cameras, rounds=1)
    points, misfit = points[0], np.where(np.isfinite(points[0, :, 0]), 0.0, np.inf)
    for camera, lens in enumerate(lenses):
        seen = known[camera, 0]
        off = _pixel_distances(lens, state.cameras[camera], points[seen], pixels[camera, seen])
        misfit[seen] = np.maximum(misfit[seen], off / max(lens.width, lens.height))
    return misfit
