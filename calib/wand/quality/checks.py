# SPDX-License-Identifier: BSD-3-Clause
"""Checks an adjustment against the files that it was given: lenses, camera names, and the wand's dimensions."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.camera import LENS, lens_parameters
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.bundle_adjustment.residuals import point_jacobians, predict_markers
from calib.wand.detections import WandDetections, ranges
from calib.wand.quality.clock_jump import find_jump
from camera_node.foundation.arrays import Array, Index
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

MIN_AGREEING = 0.5  # share of a camera's detections that must fit the rig
MAX_SIZE_ERROR = 0.04  # of the distance: the median error of roundel sizes is below it
MAX_SPACING_ERROR = 0.03  # of the wand's length: the error of any distance between its markers is below it
MIN_MEASURED = 8  # frame sets at which a distance is measured
MIN_MOTION = 0.02  # of an image's longer side, that the wand moves
WRONG_CLOCK_S = (
    1.0  # offset: synchronized clocks differ by milliseconds, unsynchronized ones by more than a second
)
SAME_LENS = 3.0  # sigmas, per parameter, within which a lens is that of another camera
OTHER_LENS = 1e-9  # probability of the difference, below which a lens is not that of its own file


def check_lenses(names: Sequence[str], adjusted: Adjusted) -> None:
    """Raise CameraFault where the lenses of two cameras are swapped."""
    lenses, cov = adjusted.problem.lenses, camera_covariance(adjusted).of(LENS)
    found = [adjusted.state.lens(k, lens) for k, lens in enumerate(lenses)]
    for a, b in combinations(adjusted.problem.estimated_cameras(), 2):
        crossed = _distance(found[a], lenses[b], cov[a, :, a]), _distance(found[b], lenses[a], cov[b, :, b])
        straight = _distance(found[a], lenses[a], cov[a, :, a]), _distance(found[b], lenses[b], cov[b, :, b])
        if max(crossed) < min(SAME_LENS, min(straight) / 2) and _probability(min(straight)) < OTHER_LENS:
            swapped = (
                "its detections fit the intrinsics of '{}', and vice versa; swap the two in the rig file"
            )
            raise CameraFault({names[a]: swapped.format(names[b]), names[b]: swapped.format(names[a])})


def _distance(found: Lens, given: Lens, cov: Array) -> float:
    """Distance of two lenses in sigmas, root mean square of the adjusted parameters."""
    off = lens_parameters(found) - lens_parameters(given)
    return float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))


def _probability(distance: float) -> float:
    """Probability of a distance of two lenses in sigmas, root mean square, or of a larger one."""
    from scipy.special import chdtrc

    return float(chdtrc(len(LENS), len(LENS) * distance**2))


def check_clocks(names: Sequence[str], adjusted: Adjusted) -> None:
    """Raise CameraFault where a clock is farther off than the server's synchronization allows."""
    offset_s = adjusted.state.clocks[:, 0] - np.median(adjusted.state.clocks[:, 0])
    k, reference = int(np.abs(offset_s).argmax()), int(np.abs(offset_s).argmin())
    if abs(offset_s[k]) > WRONG_CLOCK_S:
        raise CameraFault(
            {
                names[k]: (
                    f"its timestamps are {abs(offset_s[k]):.2f} s {'earlier' if offset_s[k] > 0 else 'later'} than "
                    f"those of '{names[reference]}'; set its clock (chrony or NTP) and record again"
                )
            }
        )


def check_agreement(names: Sequence[str], adjusted: Adjusted, observations: WandObservations) -> None:
    """Raise CameraFault where most detections of a camera contradict those of the other cameras.

    Only the worst camera is named, because a wrong camera makes others look wrong. The d parameters of a camera's pose
    and clock fit d coordinates of any detections, so these do not count.
    """
    total = np.bincount(observations.camera, minlength=len(names))
    fitting = np.bincount(observations.camera[adjusted.used], minlength=len(names))
    share = (fitting - len(set(adjusted.problem.free) - set(LENS)) / 2) / total
    if share.min() < MIN_AGREEING:
        k = int(share.argmin())
        jump = find_jump(names, adjusted, observations)
        if jump is not None and jump.camera == names[k]:
            raise CameraFault({names[k]: jump.sentence()}, certain=False)
        reason = (
            f"only {fitting[k]} of its {total[k]} detections fit those of the other cameras: if it has few, wave the "
            "wand in front of it; else check that its name and its intrinsics are its own and that it did not move; "
            f"run roundel calibrate intrinsics --camera {names[k]}, or leave it out"
        )
        raise CameraFault({names[k]: reason}, certain=False)


def check_motion(detections: WandDetections, names: Sequence[str], lenses: Sequence[Lens]) -> None:
    """Raise CalibrationError where no camera saw the wand move: a wand at rest determines little, and no clock."""
    moved, share = {}, {}
    for k, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        for marker in np.unique(detections.label[detections.camera == k]):
            uv = detections.uv[(detections.camera == k) & (detections.label == marker)]
            away = float(np.quantile(np.linalg.norm(uv - np.median(uv, axis=0), axis=1), 0.95))
            moved[name] = max(moved.get(name, 0.0), away)
            share[name] = moved[name] / max(lens.width, lens.height)
    if share and max(share.values()) < MIN_MOTION:
        name = max(moved, key=moved.__getitem__)
        raise CalibrationError(
            f"the wand hardly moved: by {moved[name]:.1f} px in the image of '{name}', and less in the others; wave it "
            "through the whole volume"
        )


def check_spacing(wand: Body, adjusted: Adjusted, observations: WandObservations) -> None:
    """Raise CalibrationError where the cameras measure other distances between the wand's markers than its file has."""
    pairs = np.array(list(combinations(range(len(wand.markers)), 2)), np.intp)
    if len(pairs) < 2:
        return
    given = _distances(wand.points[None], pairs)[0]
    measured = _distances(triangulate_markers(adjusted, observations), pairs)
    known = np.isfinite(measured).sum(axis=0) >= MIN_MEASURED
    if not known.any():
        return
    found = np.nanmedian(measured[:, known], axis=0)
    worst = int(np.abs(found - given[known]).argmax())
    if abs(found[worst] - given[known][worst]) > MAX_SPACING_ERROR * given.max():
        a, b = pairs[known][worst]
        raise CalibrationError(
            f"the wand differs from its file: markers {a} and {b} are {given[known][worst]:.3f} m apart there, and "
            f"{found[worst]:.3f} m as the cameras measure it; measure the wand again"
        )


def check_sizes(wand: Body, adjusted: Adjusted, observations: WandObservations) -> None:
    """Raise CalibrationError where the wand's lengths give other ranges of the roundels than their sizes do."""
    state, problem = adjusted.state, adjusted.problem
    if len(problem.wand.lengths) == 0:
        return
    lenses = [state.lens(k, lens) for k, lens in enumerate(problem.lenses)]
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
    """(K, M, 3) positions of the wand's markers by the cameras alone, world; NaN where fewer than two cameras saw one.

    One Gauss-Newton step of every marker of a frame set from its adjusted position, without the wand's lengths.
    """
    state, problem, rows = adjusted.state, adjusted.problem, np.flatnonzero(adjusted.used)
    markers = np.einsum("mb,kbx->kmx", problem.wand.weights, state.motion[:, 0])
    camera, k, m = observations.camera[rows], observations.knot[rows], observations.label[rows]
    lenses = [state.lens(c, lens) for c, lens in enumerate(problem.lenses)]
    J = np.nan_to_num(point_jacobians(lenses, state.cameras, camera, markers[k, m])[1])
    weight, residuals = np.linalg.inv(observations.cov[rows]), np.nan_to_num(adjusted.residuals[rows])
    A, b = np.zeros((*markers.shape, 3)), np.zeros(markers.shape)
    np.add.at(A, (k, m), np.swapaxes(J, 1, 2) @ weight @ J)
    np.add.at(b, (k, m), np.einsum("nji,njk,nk->ni", J, weight, residuals))
    views = np.zeros((*markers.shape[:2], len(problem.lenses)))
    views[k, m, camera] = 1
    observed = views.sum(axis=2) >= 2
    points = np.full(markers.shape, np.nan)
    points[observed] = markers[observed] + np.linalg.solve(A[observed], b[observed][:, :, None])[:, :, 0]
    return points


def measure_lengths(adjusted: Adjusted, observations: WandObservations) -> Array:
    """(n,) errors of the wand's lengths as the cameras alone measure them, metres."""
    wand = adjusted.problem.wand
    markers = triangulate_markers(adjusted, observations)
    errors = _distances(markers[:, wand.basis], wand.pairs) - wand.lengths
    return errors[np.isfinite(errors)]


def _distances(points: Array, pairs: Index) -> Array:
    """(K, P) distances of P pairs of points (K, N, 3)."""
    ends = points[:, pairs]
    return np.asarray(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2), float)
