# SPDX-License-Identifier: BSD-3-Clause
"""What an adjustment says against the files that it was given: lenses, names and the wand's measures."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.camera import LENS
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.bundle_adjustment.lens_prior import usual_sigma
from calib.wand.bundle_adjustment.optimizer import Adjusted
from calib.wand.bundle_adjustment.problem import WandObservations
from calib.wand.bundle_adjustment.residuals import predict_markers
from calib.wand.detections import WandDetections, ranges
from calib.wand.quality.clock_jump import find_jump
from calib.wand.quality.lengths import distances, free_markers
from camera_node.arrays import Array
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

AGREE = 0.5  # of a camera's sightings must fit the rig, beside those that its pose and clock fit anyway
SIZE = 0.04  # of the distance: what no roundel's size is off by, in the median of a wave
SPACING = 0.03  # of the wand's length: what no distance of two of its markers is off by
FEW = 8  # moments at which a distance is measured
MOVES = 0.02  # of an image's longer side: a wand that stays within is not waved
WRONG = 3.0  # usual standard deviations of a lens without figures: beyond, it is another lens
SAME = 3.0  # sigmas, per parameter: a lens that is another camera's


def check_lenses(names: Sequence[str], adjusted: Adjusted) -> None:
    """Raise CameraFault where lenses are other cameras', or far from those that were given."""
    lenses, cov = adjusted.problem.lenses, camera_covariance(adjusted).of(LENS)
    found = [adjusted.state.lens(k, lens) for k, lens in enumerate(lenses)]
    for a, b in combinations(adjusted.problem.estimated_cameras(), 2):
        crossed = _apart(found[a], lenses[b], cov[a, :, a]), _apart(found[b], lenses[a], cov[b, :, b])
        straight = _apart(found[a], lenses[a], cov[a, :, a]), _apart(found[b], lenses[b], cov[b, :, b])
        if max(crossed) < SAME < min(straight):
            told = "what it saw fits the intrinsics of '{}', and the other way round: swap the two in the rig file"
            raise CameraFault({names[a]: told.format(names[b]), names[b]: told.format(names[a])})
    reasons = {}
    for name, given, lens in zip(names, lenses, found, strict=True):
        off = np.array([np.log(lens.fx / given.fx), lens.cx - given.cx, lens.cy - given.cy])
        if (np.abs(off) > WRONG * usual_sigma(given)[:3]).any():
            reasons[name] = (
                f"wrong intrinsics: what it saw fits f = {lens.fx:.0f} px and a centre at "
                f"({lens.cx:.0f}, {lens.cy:.0f}), its file says {given.fx:.0f} px and "
                f"({given.cx:.0f}, {given.cy:.0f}); is its name right? "
                f"else run python -m calib intrinsics --camera {name}"
            )
    if reasons:
        raise CameraFault(reasons)


def _apart(found: Lens, given: Lens, cov: Array) -> float:
    """Distance of two lenses in sigmas, root mean square of the adjusted parameters."""
    k1 = [lens.distortion[0] if lens.distortion else 0.0 for lens in (found, given)]
    focal = np.log(found.fx * found.fy / (given.fx * given.fy)) / 2
    off = np.array([focal, found.cx - given.cx, found.cy - given.cy, k1[0] - k1[1]])
    return float(np.sqrt(off @ np.linalg.solve(cov, off) / len(off)))


def check_agreement(names: Sequence[str], adjusted: Adjusted, seen: WandObservations) -> None:
    """Raise CameraFault where much of what a camera saw fits nothing that the others saw.

    The worst one, as one that is wrong makes others look wrong. The d parameters of a camera's pose and clock
    fit d coordinates wherever it stands: those tell nothing.
    """
    sightings = np.bincount(seen.camera, minlength=len(names))
    fitting = np.bincount(seen.camera[adjusted.used], minlength=len(names))
    share = (fitting - len(set(adjusted.problem.free) - set(LENS)) / 2) / sightings
    if share.min() < AGREE:
        k = int(share.argmin())
        jump = find_jump(names, adjusted, seen)
        if jump is not None and jump.camera == names[k]:
            raise CameraFault({names[k]: jump.words()}, certain=False)
        told = (
            f"only {fitting[k]} of its {sightings[k]} sightings fit what the others saw: if these are few, wave before "
            "it; else are its name and its intrinsics its own, and did it stand still? run python -m calib intrinsics "
            f"--camera {names[k]}, or leave it out"
        )
        raise CameraFault({names[k]: told}, certain=False)


def check_motion(wave: WandDetections, names: Sequence[str], lenses: Sequence[Lens]) -> None:
    """Raise CalibrationError where no camera saw the wand move: a wand at rest fixes little, and nothing of clocks."""
    moved, share = {}, {}
    for k, (name, lens) in enumerate(zip(names, lenses, strict=True)):
        for marker in np.unique(wave.label[wave.camera == k]):
            uv = wave.uv[(wave.camera == k) & (wave.label == marker)]
            away = float(np.quantile(np.linalg.norm(uv - np.median(uv, axis=0), axis=1), 0.95))
            moved[name] = max(moved.get(name, 0.0), away)
            share[name] = moved[name] / max(lens.width, lens.height)
    if share and max(share.values()) < MOVES:
        name = max(moved, key=moved.__getitem__)
        raise CalibrationError(
            f"the wand hardly moved: by {moved[name]:.1f} px before '{name}', and less before others; wave it through "
            "the whole volume"
        )


def check_spacing(wand: Body, adjusted: Adjusted, seen: WandObservations) -> None:
    """Raise CalibrationError where the cameras see the wand's markers at other distances than its file has."""
    pairs = np.array(list(combinations(range(len(wand.markers)), 2)), np.intp)
    if len(pairs) < 2:
        return
    told = distances(wand.points[None], pairs)[0]
    measured = distances(free_markers(adjusted, seen), pairs)
    known = np.isfinite(measured).sum(axis=0) >= FEW
    if not known.any():
        return
    found = np.nanmedian(measured[:, known], axis=0)
    worst = int(np.abs(found - told[known]).argmax())
    if abs(found[worst] - told[known][worst]) > SPACING * told.max():
        a, b = pairs[known][worst]
        raise CalibrationError(
            f"the wand is not as its file says: markers {a} and {b} are {told[known][worst]:.3f} m apart there, and "
            f"{found[worst]:.3f} m by what the cameras saw; measure the wand again"
        )


def check_sizes(wand: Body, adjusted: Adjusted, seen: WandObservations) -> None:
    """Raise CalibrationError where the wand's lengths put roundels elsewhere than their sizes do."""
    state, problem = adjusted.state, adjusted.problem
    if len(problem.wand.lengths) == 0:
        return
    lenses = [state.lens(k, lens) for k, lens in enumerate(problem.lenses)]
    points = predict_markers(problem, seen, state).points
    far = np.linalg.norm(points - state.cameras[seen.camera, :3, 3], axis=1)
    ratio = ranges(lenses, seen, wand.diameter_m) / far
    known = np.isfinite(ratio) & adjusted.used
    if not known.any() or abs(np.log(factor := float(np.median(ratio[known])))) < SIZE:
        return
    raise CalibrationError(
        f"the wand's lengths and its roundels' sizes disagree by {abs(factor - 1):.0%}: by the lengths, the black disc "
        f"is {wand.diameter_m / factor:.4f} m across, the wand file says {wand.diameter_m:.4f} m; measure both again"
    )
