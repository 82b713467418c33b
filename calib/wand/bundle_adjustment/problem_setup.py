# SPDX-License-Identifier: BSD-3-Clause
"""Builds the bundle adjustment of a labeled recording: its frame sets, the initial motion, and the observations."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calib.wand.background import match_points
from calib.wand.bundle_adjustment.eliminated_points import start_points
from calib.wand.bundle_adjustment.frame_sets import choose_frame_sets, group_frames
from calib.wand.bundle_adjustment.initial_motion import initial_positions
from calib.wand.bundle_adjustment.lens_prior import coarse_sigma
from calib.wand.bundle_adjustment.problem import Estimate, Problem, State, WandObservations
from calib.wand.detections import WandDetections, normalise
from calib.wand.initialization.two_view import TwoViewGeometry
from calib.wand.labeling.labels import WandRecording
from calib.wand.timing import Timing
from calib.wand.tracks import MarkerTrack, build_tracks
from calib.wand.trajectory import AffineWand, acceleration_density, finite_velocities
from camera_node.foundation.arrays import Array, Index, Mask
from camera_node.geometry.body import Body
from camera_node.geometry.lens import Lens

MIN_SIGMA_PX = 0.02  # error of every lens model, in addition to the covariance of the detector
MIN_KNOTS = 2


@dataclass(frozen=True, slots=True)
class LabeledRecording:
    """The labeled detections of C placed cameras, numbered 0 to C - 1.

    Attributes:
        detections: of these cameras.
        names, lenses: of the cameras.
        tracks: by camera and marker, by stamps.
        wand: that was recorded.
        timing: how their frames are related in time.
        middle_s: stamp in the middle of the recording, at which time offsets are defined.
        readout_s: (C,) given readout times, which the times of detections contain.
        background: images of background points in these cameras, if there are any.
    """

    detections: WandDetections
    names: Sequence[str]
    lenses: Sequence[Lens]
    tracks: Sequence[Sequence[MarkerTrack]]
    wand: Body
    timing: Timing
    middle_s: float
    readout_s: Array
    background: WandDetections | None = None

    @classmethod
    def of(
        cls, recording: WandRecording, pairs: TwoViewGeometry, placed: Sequence[int]
    ) -> "LabeledRecording":
        """The cameras `placed` of a recording, renumbered in this order."""
        number = np.full(len(recording.names), -1)
        number[placed] = np.arange(len(placed))
        detections = _renumber(recording.detections, number)
        t_s, given_s = recording.frames.t_s, recording.frames.readout_s
        last = np.searchsorted(recording.frames.camera, placed, side="right") - 1
        return cls(
            detections,
            [recording.names[k] for k in placed],
            [recording.lenses[k] for k in placed],
            [pairs.tracks[k] for k in placed],
            pairs.wand,
            recording.timing,
            float(t_s.min() + t_s.max()) / 2,
            given_s[last],
            None if recording.background is None else _renumber(recording.background, number),
        )

    def with_centres(self, rows: Index, uv: Array) -> "LabeledRecording":
        """The recording with other centres (n, 2), raw pixels, of the detections `rows` (n,)."""
        changed = self.detections.uv.copy()
        changed[rows] = uv
        xy = normalise(self.lenses, self.detections.camera, changed)
        return self._with(replace(self.detections, uv=changed, xy=xy))

    def with_row_times(self, readout_s: Array) -> "LabeledRecording":
        """The recording with stamps of rows for readout times (C,) that are longer by this."""
        detections = self.detections
        later = readout_s[detections.camera] * detections.image_row
        return self._with(replace(detections, t_s=detections.t_s + later))

    def select(self, rows: Mask) -> "LabeledRecording":
        """The recording with some of its detections (n,) only."""
        return self._with(self.detections.select(rows))

    def _with(self, detections: WandDetections) -> "LabeledRecording":
        tracks = build_tracks(detections, len(self.lenses), len(self.wand.markers))
        return replace(self, detections=detections, tracks=tracks)

    def undistort_tracks(self, lenses: Sequence[Lens]) -> "LabeledRecording":
        """The recording with its tracks undistorted by other lenses; `lenses` stay the given ones."""
        tracks = [
            [
                MarkerTrack.of(
                    track.t_s, new.normalise(old.project(np.column_stack([track.xy, np.ones(len(track.xy))])))
                )
                for track in mine
            ]
            for mine, old, new in zip(self.tracks, self.lenses, lenses, strict=True)
        ]
        return replace(self, tracks=tracks)


def _renumber(detections: WandDetections, number: Index) -> WandDetections:
    """The detections of the cameras whose `number` (C,) is not negative, under these."""
    camera = number[detections.camera]
    return replace(detections, camera=camera).select(camera >= 0)


def build_problem(
    recording: LabeledRecording, cameras: Array, offset_s: Array, budget: int
) -> Estimate | None:
    """Build the problem around a rig that is nearly right.

    Args:
        recording: labeled detections.
        cameras: (C, 4, 4) T_world_cam.
        offset_s: (C,) true time = stamp + offset.
        budget: number of frame sets to use, about.

    Returns:
        the problem with its start; None where fewer than two frame sets give the wand's position.
    """
    rows, knot, knot_s = _choose_detections(recording, offset_s, budget)
    wand, gap_s = AffineWand.of(recording.wand), recording.timing.gap_s
    basis = initial_positions(recording.tracks, wand, cameras, offset_s, knot_s, gap_s)
    known = np.asarray(np.isfinite(basis).all(axis=(1, 2)))
    if known.sum() < MIN_KNOTS:
        return None
    renumbered = np.cumsum(known) - 1
    rows, knot = rows[known[knot]], renumbered[knot[known[knot]]]
    knot_s, basis = knot_s[known], basis[known]
    density = acceleration_density(knot_s, basis, gap_s)
    lens_sigma = np.array([coarse_sigma(lens) for lens in recording.lenses])
    problem = Problem(
        lenses=list(recording.lenses),
        wand=wand,
        knot_s=knot_s,
        gap_s=gap_s,
        density=density,
        middle_s=recording.middle_s,
        lens_sigma=lens_sigma,
        readout_s=recording.readout_s,
    )
    motion = np.stack([basis, finite_velocities(knot_s, basis, gap_s)], axis=1)
    return Estimate(problem, State.of(cameras, offset_s, motion), _observations(recording, rows, knot))


def add_background(recording: LabeledRecording, estimate: Estimate) -> Estimate:
    """The estimate with the recording's background points, matched and located by its cameras and clocks."""
    if (images := recording.background) is None:
        return estimate
    problem, state = estimate.problem, estimate.state
    points = match_points(images, state.true_times(images, problem.middle_s), problem.gap_s)
    problem, state = start_points(problem, state, points)
    return replace(estimate, problem=problem, state=state)


def _choose_detections(
    recording: LabeledRecording, offset_s: Array, budget: int
) -> tuple[Index, Index, Array]:
    """The n detections of the chosen frame sets, (n,) their knots, and (K,) the knots' times."""
    detections = recording.detections
    true_s = detections.t_s + offset_s[detections.camera]
    order = np.argsort(true_s, kind="stable")
    frame_set = _frame_sets(recording, true_s, order)
    rows = order[frame_set[order] >= 0]
    sizes = np.array([(lens.width, lens.height) for lens in recording.lenses], float)
    chosen = choose_frame_sets(detections.select(rows), frame_set[rows], sizes, budget)
    rows = rows[chosen[frame_set[rows]]]
    knot = np.unique(frame_set[rows], return_inverse=True)[1]
    return rows, knot, _middle_times(true_s[rows], knot)


def _frame_sets(recording: LabeledRecording, true_s: Array, order: Index) -> Index:
    """(n,) the frame set of every detection, -1 where only one camera has a frame."""
    detections = recording.detections
    frames, first, back = np.unique(detections.frame[order], return_index=True, return_inverse=True)
    t_s, camera = true_s[order][first], detections.camera[order][first]
    by_time = np.argsort(t_s, kind="stable")
    of_frame = np.empty(len(frames), np.intp)
    of_frame[by_time] = group_frames(t_s[by_time], camera[by_time], recording.timing.spread_s)
    frame_set = np.empty(len(order), np.intp)
    frame_set[order] = of_frame[back]
    return frame_set


def _middle_times(t_s: Array, knot: Index) -> Array:
    """(K,) the middle between the first and the last time of each knot: two knots are never close together."""
    low, high = np.full(knot.max() + 1, np.inf), np.full(knot.max() + 1, -np.inf)
    np.minimum.at(low, knot, t_s)
    np.maximum.at(high, knot, t_s)
    return (low + high) / 2


def _observations(recording: LabeledRecording, rows: Index, knot: Index) -> WandObservations:
    detections = recording.detections.select(rows)
    return WandObservations(
        row=rows,
        camera=detections.camera,
        knot=knot,
        label=detections.label,
        t_s=detections.t_s,
        stamp_sigma_s=detections.stamp_sigma_s,
        image_row=detections.image_row,
        uv=detections.uv,
        cov=detections.cov + MIN_SIGMA_PX**2 * np.eye(2),
        axes_px=detections.axes_px,
        angle_rad=detections.angle_rad,
    )
