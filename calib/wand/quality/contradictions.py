# SPDX-License-Identifier: BSD-3-Clause
"""What reconciles a recording with its rig, where noise does not explain what remains.

Each hypothesis changes one thing, and the one that explains the recording is named: images of all cameras mirrored, by
the lenses (Bayes factor) or by a wand whose markers are not in a plane; or a camera that moved, by a second pose that
fits what the first one leaves.
"""

import cv2
import numpy as np

from calib.errors import CalibrationError, CameraFault
from calib.rig.camera import lens_parameters
from calib.rig.estimation import CHANCE, GROSS, coordinate_sigma
from calib.wand.bundle_adjustment.covariance import lens_evidence
from calib.wand.bundle_adjustment.problem import Adjusted
from calib.wand.bundle_adjustment.problem_setup import MIN_SIGMA_PX
from calib.wand.detections import WandRecording
from calib.wand.quality.checks import (
    GATE,
    MIN_COUNT,
    MIN_SHARE,
    TriangulatedResiduals,
    triangulated_residuals,
)
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens
from camera_node.geometry.pose import invert, motion_from, rotation_angle

HALF = 0.5  # of a camera's contradicting detections, by which a motion must explain more of all
MIRRORS = {"left to right": (True, False), "top to bottom": (False, True), "": (True, True)}


def check_mirrored(wand: Body, adjusted: Adjusted) -> None:
    """Raise CalibrationError where the images of all cameras are mirrored.

    Mirrored images show a mirrored arena, which fits as well: only the lenses, whose centres are not in the middle of
    the image, and a wand whose markers are not in a plane, tell it from the true one.
    """
    if _is_mirrored_body(wand, adjusted):
        raise CalibrationError(
            "the wand's markers are mirrored against its file: the images of all cameras are mirrored, or an axis of "
            "the wand file points the wrong way; disable the flip of the cameras (or replace u by width - 1 - u), or "
            "correct the signs of one axis in the wand file"
        )
    evidence = {name: lens_evidence(adjusted, _mirror(adjusted, *axes)) for name, axes in MIRRORS.items()}
    name = max(evidence, key=evidence.__getitem__)
    if evidence[name] > -np.log(CHANCE) and name:
        u = "u by width - 1 - u" if name == "left to right" else "v by height - 1 - v"
        raise CalibrationError(
            f"the images of all cameras are mirrored {name}: so mirrored, their lenses fit those of the rig file "
            f"(Bayes factor e^{evidence[name]:.0f}); disable the flip, or replace {u} in the recording"
        )


def _mirror(adjusted: Adjusted, across: bool, upright: bool) -> Array:
    """(C, 9) the lenses of mirrored images, as corrections of the given ones."""
    return np.array(
        [
            lens_parameters(_mirrored(lens, across, upright)) - lens_parameters(lens)
            for lens in adjusted.problem.lenses
        ]
    )


def _mirrored(lens: Lens, across: bool, upright: bool) -> Lens:
    """The lens of an image that is mirrored left to right, or top to bottom, or both."""
    parameters = lens.parameters.copy()
    if across:
        parameters[2] = lens.width - 1 - parameters[2]
    if upright:
        parameters[3] = lens.height - 1 - parameters[3]
    if lens.model == "pinhole" and len(parameters) >= 8:
        parameters[6:8] *= [-1.0 if upright else 1.0, -1.0 if across else 1.0]  # p1, p2
    return lens.with_parameters(parameters)


def _is_mirrored_body(wand: Body, adjusted: Adjusted) -> bool:
    """Whether most of the motion has the wand's mirror image; lengths alone do not tell them apart."""
    basis = adjusted.problem.wand.basis
    if len(basis) < 4:
        return False
    file, points = wand.points[basis], adjusted.state.motion[:, 0]
    volume = np.linalg.det(points[:, 1:] - points[:, :1])
    given = np.linalg.det(file[1:] - file[0])
    return bool(np.mean(volume * given < 0) > HALF)


def check_residuals(recording: WandRecording, adjusted: Adjusted) -> TriangulatedResiduals:
    """Refuse a rig that the recording contradicts.

    Args:
        recording: detections of C cameras.
        adjusted: the rig.

    Returns:
        The residuals of the detections.

    Raises:
        CameraFault: a camera moved during the recording.
        CalibrationError: most of the detections contradict the rig, or by more than any noise, or the adjustment did
            not converge.
    """
    state = adjusted.state
    residuals = triangulated_residuals(recording, state)
    lenses = state.corrected(recording.lenses)
    off = np.linalg.norm(residuals.pixels, axis=1)
    known = np.isfinite(off)
    if not known.any():
        return residuals
    usual = max(coordinate_sigma(off[known]), MIN_SIGMA_PX)
    gross = known & (off > GROSS * usual)
    moved: list[tuple[int, str, str]] = []
    for k, lens in enumerate(lenses):
        mine = recording.detections.camera == k
        explained, sentence = _explain_motion(
            recording, residuals.points, mine & known, mine & gross, state.cameras[k], lens
        )
        moved.append((explained, recording.names[k], sentence))
    # A camera that moved makes others look wrong: only the one whose motion explains most is named.
    if (most := max(moved))[0]:
        raise CameraFault({most[1]: most[2]})
    size = max(max(lens.width, lens.height) for lens in lenses)
    if not adjusted.converged or usual > GATE * size or gross.sum() > HALF * known.sum():
        raise CalibrationError(
            f"the recording contradicts every rig that was found: half of the detections are {usual:.3g} px or more "
            f"from where the other cameras see them, and {gross.sum() / known.sum():.0%} are gross errors; no single "
            "camera that moved, no clock, mirrored image or exchanged camera explains it. In case several cameras "
            "moved, calibrate the first and the second half of the recording on their own (roundel trim); then pairs "
            "of cameras (leave the others out) to find the ones that contradict"
        )
    return residuals


def _explain_motion(
    recording: WandRecording, points: Array, known: Mask, gross: Mask, camera: Array, lens: Lens
) -> tuple[int, str]:
    """How a camera moved, if another pose, before or after a time, explains most detections that contradict its own,
    and their number; else 0.

    Args:
        recording: all detections.
        points: (n, 3) their markers, world.
        known, gross: (n,) detections of the camera with a marker, and those of them that contradict the rig.
        camera: (4, 4) T_world_cam.
        lens: of the camera.
    """
    rows = np.flatnonzero(gross)
    if len(rows) < max(MIN_COUNT, MIN_SHARE * known.sum()):
        return 0, ""
    gate = GATE * max(lens.width, lens.height) / ((lens.fx + lens.fy) / 2)
    xy = lens.normalise(recording.detections.uv[rows])
    fitted, turn, shift, inliers = cv2.solvePnPRansac(
        points[rows], xy, np.eye(3), np.zeros(4), reprojectionError=gate, flags=cv2.SOLVEPNP_EPNP
    )
    if not fitted or inliers is None or len(inliers) < max(MIN_COUNT, HALF * len(rows)):
        return 0, ""
    there = invert(motion_from(turn, shift))
    apart = np.linalg.norm(there[:3, 3] - camera[:3, 3])
    turned = np.degrees(rotation_angle(there[:3, :3] @ camera[:3, :3].T))
    t_s, fitting = recording.detections.t_s, rows[np.asarray(inliers, np.intp).ravel()]
    at_s, gain = _find_motion(t_s[known & ~gross], t_s[fitting])
    if gain < max(MIN_COUNT, HALF * len(rows)):
        return 0, ""
    return len(fitting), (
        f"at {at_s:.1f} s of the recording it moved by {apart:.3f} of the rig's units and turned by {turned:.1f} "
        f"degrees: this pose explains {len(fitting)} of the {len(rows)} detections that contradict the rig. Calibrate "
        "the parts of the recording before and after that on their own, or leave the camera out. Did nothing move? A "
        "wand that is seen from its other side from then on needs thickness_m in its file"
    )


def _find_motion(first: Array, second: Array) -> tuple[float, int]:
    """The time at which a camera most likely changes from one pose to another, in either order, and how many more
    detections it then explains than one pose alone: where the other pose is said to hold, the first explains none.

    Args:
        first, second: (n,), (m,) times of the detections that fit either pose, seconds.
    """
    t_s = np.concatenate([first, second])
    order = np.argsort(t_s, kind="stable")
    until = np.cumsum(np.where(order < len(first), -1, 1))
    gains = np.maximum(until, until[-1] - until)  # the other pose holds until then, or from then on
    k = int(gains.argmax())
    return float(t_s[order[k]]), int(gains[k])
