# SPDX-License-Identifier: BSD-3-Clause
"""From a waved wand to a rig: label, start from pairs, adjust, choose a world."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.adjustment import Adjusted, Observations, Problem, State, adjust
from calib.errors import CalibrationError
from calib.instants import frame_period_ns, group_instants
from calib.labelling import label_views
from calib.pairwise import relate_all
from calib.report import CameraReport, Outlier, WandReport
from calib.rig import Rig
from calib.start import explain_unplaced, place_cameras, spanning_tree, triangulate
from calib.trajectory import AffineWand, acceleration_density, finite_velocities
from calib.views import View
from calib.world import move, upright
from camera_node.body import Body
from camera_node.messages import Detections
from camera_node.pose import Pose

Array = NDArray[np.float64]

MIN_SIGMA_PX = 0.02  # no lens model is better than this, whatever a detector claims
LENGTH_SLACK = 0.25  # of a wand length at the start: beyond, a detection is wrong


@dataclass(frozen=True, slots=True)
class Calibration:
    """A rig with poses and covariances, what there is to say of it, and the adjustment.

    Attributes:
        rig, report: the result.
        names: of the C placed cameras, the order of all below.
        adjusted: the adjustment; `observations` are its rows.
        covariance: (6C, 6C) of all poses together, each in its camera's own frame, rotation then translation, the world
            being where the cameras are on average.
    """

    rig: Rig
    report: WandReport
    names: list[str]
    adjusted: Adjusted
    observations: Observations
    covariance: Array


def calibrate(rig: Rig, wand: Body, messages: Sequence[Detections]) -> Calibration:
    """Place the cameras of a rig by a wand waved before them.

    Args:
        rig: intrinsics of every camera; poses in it are not used.
        wand: its markers; two of them or more give the scale, one gives it only by the roundel's size.
        messages: detections of all cameras, any order; a roundel's `id`, where given, is its marker number.

    Returns:
        the rig with the poses of all cameras that could be placed, and the report.

    Raises:
        CalibrationError: the recording or the wand can't place two cameras; the message says why.
    """
    check_recording(rig, messages)
    lenses = {name: rig.cameras[name] for name in sorted({message.camera for message in messages})}
    views, left_out = label_views(messages, wand, lenses)
    instants = group_instants(views, frame_period_ns(messages))
    if not instants:
        raise CalibrationError(_unseen(views, left_out))
    pairs, shared = relate_all(instants, lenses, wand)
    start = place_cameras(spanning_tree(pairs))
    counts = Counter(view.camera for view in views)
    unplaced = explain_unplaced(sorted(rig.cameras), list(start), counts, shared)
    if len(start) < 2:
        told = "; ".join(f"camera '{name}': {reason}" for name, reason in unplaced.items())
        raise CalibrationError(
            f"no two cameras could be placed; wave where two see the wand at once ({told})"
        )
    return _solve(rig, wand, start, instants, left_out, unplaced, views, metric=pairs[0].metric)


def check_recording(rig: Rig, messages: Sequence[Detections]) -> None:
    """Raise CalibrationError where a recording can't belong to a rig, or has fewer than two cameras."""
    sizes = {message.camera: (message.width, message.height) for message in messages}
    if unknown := sorted(set(sizes) - set(rig.cameras)):
        raise CalibrationError(
            f"camera '{unknown[0]}' of the recording is not in the rig, which has "
            f"{', '.join(sorted(rig.cameras))}; run python -m calib intrinsics --camera {unknown[0]}"
        )
    if len(sizes) < 2:
        only = f"one camera, '{next(iter(sizes))}'" if sizes else "no camera"
        raise CalibrationError(f"the recording has {only}; a wand calibration needs two or more")
    for name, (width, height) in sizes.items():
        lens = rig.cameras[name]
        if (width, height) != (lens.width, lens.height):
            raise CalibrationError(
                f"camera '{name}' delivers {width} x {height} pixels, its intrinsics are for "
                f"{lens.width} x {lens.height}; record at that size or calibrate the lens again"
            )


def _unseen(views: Sequence[View], left_out: dict[str, Counter[str]]) -> str:
    if views:
        seen = ", ".join(f"{name} {n}" for name, n in sorted(Counter(v.camera for v in views).items()))
        return f"no two cameras ever saw the wand at once (frames with the wand: {seen}); wave where views overlap"
    reasons = sum(left_out.values(), Counter())
    told = ", ".join(f"{reason}: {n}" for reason, n in reasons.most_common())
    return f"the wand was in no frame ({told}); do the wand file's diameter and markers match the wand?"


def _solve(
    rig: Rig,
    wand: Body,
    start: dict[str, Array],
    instants: list[list[View]],
    left_out: dict[str, Counter[str]],
    unplaced: dict[str, str],
    views: Sequence[View],
    metric: bool,
) -> Calibration:
    names = sorted(start)
    instants = [[view for view in instant if view.camera in start] for instant in instants]
    affine = AffineWand.of(wand)
    basis = _start_basis(triangulate(instants, start, len(wand.markers)), affine)
    good = np.array([np.isfinite(points).all() for points in basis], bool)
    for instant in (instant for instant, ok in zip(instants, good, strict=True) if not ok):
        for view in instant:
            left_out[view.camera]["instant without two good views of the wand"] += 1
    instants, basis = [instant for instant, ok in zip(instants, good, strict=True) if ok], basis[good]
    if not instants:
        raise CalibrationError(
            "the wand's lengths do not fit what the cameras saw: is the wand file right, "
            "and are the intrinsics those of these cameras?"
        )
    problem, state, observations = _pose_problem(rig, names, start, affine, instants, basis, metric)
    adjusted = adjust(problem, observations, state)
    return _conclude(rig, names, problem, observations, adjusted, left_out, unplaced, views, metric)


def _start_basis(markers: Array, affine: AffineWand) -> Array:
    """Basis markers (K, B, 3) from triangulated ones (K, M, 3); NaN where lengths are wrong or too few are known."""
    basis = np.full((len(markers), len(affine.basis), 3), np.nan)
    for k, points in enumerate(markers):
        known = np.isfinite(points).all(axis=1)
        if np.linalg.matrix_rank(affine.weights[known], tol=1e-6) == len(affine.basis):
            basis[k] = np.linalg.lstsq(affine.weights[known], points[known], rcond=None)[0]
    ends = basis[:, affine.pairs]
    lengths = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2)
    basis[(np.abs(lengths - affine.lengths) > LENGTH_SLACK * affine.lengths).any(axis=1)] = np.nan
    return basis


def _pose_problem(
    rig: Rig,
    names: list[str],
    start: dict[str, Array],
    affine: AffineWand,
    instants: list[list[View]],
    basis: Array,
    metric: bool,
) -> tuple[Problem, State, Observations]:
    origin_ns = instants[0][0].t_ns
    knot_s = 1e-9 * np.array(
        [np.mean([view.t_ns - origin_ns for view in instant]) for instant in instants], np.float64
    )
    cameras = np.array([start[name] for name in names])
    if not metric:
        # Nothing tells the scale: the two cameras that are farthest apart are one metre apart.
        far = _farthest(cameras)[2]
        cameras[:, :3, 3] /= far
        basis = basis / far
    velocity = finite_velocities(knot_s, basis)
    fixed = _farthest(cameras) if len(affine.lengths) == 0 else None
    problem = Problem(
        [rig.cameras[name] for name in names], affine, knot_s, acceleration_density(knot_s, basis), fixed
    )
    state = State(cameras, np.stack([basis, velocity], axis=1))
    return problem, state, observe(instants, names, origin_ns)


def _farthest(cameras: Array) -> tuple[int, int, float]:
    gaps = np.linalg.norm(cameras[:, None, :3, 3] - cameras[None, :, :3, 3], axis=2)
    a, b = np.unravel_index(int(gaps.argmax()), gaps.shape)
    return int(a), int(b), float(gaps[a, b])


def observe(instants: Sequence[Sequence[View]], names: Sequence[str], origin_ns: int) -> Observations:
    """The markers of all views as columns, times relative to `origin_ns`."""
    index = {name: k for k, name in enumerate(names)}
    frames = [(k, view) for k, instant in enumerate(instants) for view in instant]
    sizes = [len(view.labels) for _, view in frames]
    cov = np.concatenate([view.roundels.cov for _, view in frames]) + MIN_SIGMA_PX**2 * np.eye(2)
    return Observations(
        camera=np.repeat([index[view.camera] for _, view in frames], sizes).astype(np.intp),
        knot=np.repeat([k for k, _ in frames], sizes).astype(np.intp),
        view=np.repeat(np.arange(len(frames)), sizes),
        label=np.concatenate([view.labels for _, view in frames]),
        t_s=np.repeat([(view.t_ns - origin_ns) * 1e-9 for _, view in frames], sizes),
        uv=np.concatenate([view.roundels.uv for _, view in frames]),
        root=np.asarray(np.swapaxes(np.linalg.cholesky(np.linalg.inv(cov)), 1, 2), float),
    )


def _conclude(
    rig: Rig,
    names: list[str],
    problem: Problem,
    observations: Observations,
    adjusted: Adjusted,
    left_out: dict[str, Counter[str]],
    unplaced: dict[str, str],
    views: Sequence[View],
    metric: bool,
) -> Calibration:
    cameras = dict(rig.cameras)
    for name in unplaced:
        cameras[name] = msgspec.structs.replace(cameras[name], T_world_cam=None, covariance=None)
    joint = adjusted.joint_covariance()
    covariances = np.array([joint[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(len(names))])
    for name, T, cov in zip(names, adjusted.state.cameras, covariances, strict=True):
        rows = tuple(tuple(row) for row in cov.tolist())
        cameras[name] = msgspec.structs.replace(
            cameras[name], T_world_cam=Pose.from_matrix(T), covariance=rows
        )
    T_world = upright(adjusted.state.cameras, adjusted.state.motion[:, 0].reshape(-1, 3))
    lengths = measure_lengths(problem, observations, adjusted)
    frames = Counter(view.camera for view in views)
    rows = [
        _report_camera(name, k, observations, adjusted, covariances[k], frames[name], left_out[name])
        for k, name in enumerate(names)
    ]
    report = WandReport(
        cameras=rows,
        unplaced=unplaced,
        instants=len(problem.knot_s),
        scale=adjusted.scale,
        length_mean_mm=float(np.mean(lengths)) * 1e3 if len(lengths) else None,
        length_std_mm=float(np.std(lengths)) * 1e3 if len(lengths) else None,
        outliers=_outliers(names, observations, adjusted),
        metric=metric,
    )
    placed = move(msgspec.structs.replace(rig, cameras=cameras), T_world)
    return Calibration(placed, report, names, adjusted, observations, joint)


def _report_camera(
    name: str, k: int, seen: Observations, adjusted: Adjusted, cov: Array, frames: int, left_out: Counter[str]
) -> CameraReport:
    mine = seen.camera == k
    used = mine & adjusted.used
    rms = float(np.sqrt((adjusted.residuals[used] ** 2).sum(axis=1).mean())) if used.any() else float("nan")
    return CameraReport(
        name=name,
        frames=frames,
        frames_used=len(np.unique(seen.view[used])),
        observations=int(used.sum()),
        outliers=int((mine & ~adjusted.used).sum()),
        residual_px=rms,
        sigma_mm=float(np.sqrt(np.trace(cov[3:, 3:]) / 3)) * 1e3,
        left_out=dict(left_out),
    )


def _outliers(names: list[str], seen: Observations, adjusted: Adjusted) -> list[Outlier]:
    rows = np.flatnonzero(~adjusted.used)
    far = np.linalg.norm(adjusted.residuals, axis=1)
    return [
        Outlier(names[seen.camera[row]], float(seen.t_s[row]), int(seen.label[row]), float(far[row]))
        for row in rows[np.argsort(-far[rows])]
    ]


def measure_lengths(problem: Problem, seen: Observations, adjusted: Adjusted) -> Array:
    """What the cameras alone say of the wand's lengths, less what they are; metres.

    Every marker of an instant moves, in one Gauss-Newton step that knows no length, to where its observations want it.
    """
    state, count = adjusted.state, len(problem.wand.weights)
    markers = np.einsum("mb,kbx->kmx", problem.wand.weights, state.motion[:, 0])
    A, b = np.zeros((*markers.shape, 3)), np.zeros(markers.shape)
    views: Counter[tuple[int, int]] = Counter()
    for c, lens in enumerate(problem.lenses):
        rows = np.flatnonzero((seen.camera == c) & adjusted.used)
        T = state.cameras[c]
        k, m = seen.knot[rows], seen.label[rows]
        J = lens.project_with_jacobian((markers[k, m] - T[:3, 3]) @ T[:3, :3])[1] @ T[:3, :3].T
        J = seen.root[rows] @ J
        r = np.einsum("nij,nj->ni", seen.root[rows], adjusted.residuals[rows])
        np.add.at(A, (k, m), np.swapaxes(J, 1, 2) @ J)
        np.add.at(b, (k, m), np.einsum("nij,ni->nj", J, r))
        views.update(zip(k.tolist(), m.tolist(), strict=True))
    fixed = np.array([[views[k, m] >= 2 for m in range(count)] for k in range(len(markers))])
    free = np.full(markers.shape, np.nan)
    free[fixed] = markers[fixed] + np.linalg.solve(A[fixed], b[fixed][:, :, None])[:, :, 0]
    ends = free[:, problem.wand.basis][:, problem.wand.pairs]
    errors = np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=2) - problem.wand.lengths
    return errors[np.isfinite(errors)]
