# SPDX-License-Identifier: BSD-3-Clause
"""`calib check`: judges a rig by a wand recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from calib.commands.inputs import read_recording, require_one
from calib.commands.output import check_folder, provenance, save_maps, write_rig
from calib.commands.report import print_report
from calib.errors import CalibrationError
from calib.rig.camera import LENS, POSE
from calib.rig.rig import Rig, load_rig
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.outcome import WandCalibration
from calib.wand.quality.agreement import Agreement, Placed, compare
from calib.wand.quality.grade import assess
from calib.wand.scale import SIGMA_M, Distance
from camera_node.config import load_yaml
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.terminal import progress_console, say


@dataclass(frozen=True, kw_only=True)
class Check:
    """Judge a rig by a wand recording: whether the cameras still have the rig's poses, whether two halves of the
    recording agree, how precise the rig is where robots drive, and which camera limits it. Nothing is written without
    --maps or --out."""

    rig: Path
    """The rig to judge."""
    wand: Path = Path("configs/wand.yaml")
    """The wand of the recording: diameter_m and markers, metres."""
    frames: Path | None = None
    """Detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or read marker centres from a CSV: t_ns,camera,u,v[,marker]."""
    recording: Path | None = None
    """Or read a recording (MCAP) of calib wand --live or of python -m fusion record."""
    distance: tuple[str, str, float] | None = None
    """Two cameras and the metres between their lenses: the scale for a wand of one marker, else a check of the wand."""
    distance_sigma: float = SIGMA_M
    """Standard deviation of that distance, metres."""
    height: float = 0.1
    """Height of the robots' roundels above the floor, metres, for which errors are predicted."""
    maps: Path | None = None
    """A folder for images: each camera's residuals and where to wave next, and the expected errors."""
    out: Path | None = None
    """Write the rig with the results in its `calibration` to this file."""

    def execute(self) -> None:
        """Calibrate from the whole recording and from its halves, and compare."""
        files = {"--frames FOLDER": self.frames, "--observations CSV": self.observations}
        require_one({**files, "--recording MCAP": self.recording})
        if self.out is not None:
            check_folder(self.out)
        rig, wand = load_rig(self.rig), load_yaml(self.wand, Body)
        distance = Distance.of(self.distance, self.distance_sigma, list(rig.cameras))
        messages = read_recording(rig, self.frames, self.observations, self.recording, wand)
        figures = self._judge(rig, wand, messages, distance)
        if self.out is not None:
            calibration = {**rig.calibration, "check": {**provenance(), **figures}}
            write_rig(msgspec.structs.replace(rig, calibration=calibration), self.out)

    def _judge(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
    ) -> dict[str, Any]:
        with progress_console().status("calibrating camera poses"):
            result = calibrate(rig, wand, messages, distance)
        quality = assess(result, wand, self.height)
        print_report(result, quality)
        halves = _compare_halves(result.rig, wand, messages, distance)
        with_rig = _compare_with_rig(rig, result)
        if self.maps is not None:
            save_maps(self.maps, result, quality)
        return {**quality.as_dict(), "halves": _figures(halves), "rig": _figures(with_rig)}


def _compare_halves(
    rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
) -> Agreement | None:
    """Compare calibrations from both halves of a recording.

    Both start from the lenses of the whole recording: a half that refines lenses less would otherwise rotate its
    cameras instead. The error of a measured distance is the same in both.
    """
    exact = distance and replace(distance, sigma_m=0.0)
    try:
        with progress_console().status("calibrating camera poses from each half"):
            first, second = (calibrate(rig, wand, half, exact) for half in split(messages))
            agreement = compare(placed(first), placed(second))
    except CalibrationError as error:
        say(f"warning: the halves of the recording can't be compared: {error}")
        return None
    say(("" if agreement.holds else "warning: ") + agreement.sentence())
    return agreement


def _compare_with_rig(rig: Rig, result: WandCalibration) -> Agreement | None:
    known = Placed.of_rig(rig)
    if len([name for name in known.names if name in result.names]) < 2:
        say("the rig has no poses with covariances to compare; only the recording was judged")
        return None
    agreement = compare(known, placed(result))
    sentence = agreement.sentence("the rig and the recording")
    advice = "wave the wand again and run python -m calib wand"
    say(sentence if agreement.holds else f"warning: {sentence}; {advice}")
    return agreement


def split(messages: Sequence[Detections]) -> tuple[list[Detections], list[Detections]]:
    """The two halves of a recording, by time."""
    times = [message.t_ns for message in messages]
    middle = (min(times) + max(times)) // 2
    return [m for m in messages if m.t_ns <= middle], [m for m in messages if m.t_ns > middle]


def placed(result: WandCalibration) -> Placed:
    """The cameras of a calibration for `compare`: the covariance without the part that the lens priors cause, and that
    part by camera."""
    adjusted = result.adjusted
    free, count = list(adjusted.problem.free), len(result.names)
    pose, lens = [free.index(p) for p in POSE], [free.index(p) for p in LENS]
    by_prior = camera_covariance(adjusted).by_prior.reshape(count, len(free), count, len(free))[:, pose][
        :, :, :, lens
    ]
    by_lens = by_prior.reshape(6 * count, 4 * count)
    rest = result.covariance - by_lens @ by_lens.T
    sigma = adjusted.problem.claimed_prior_sigma()[:, lens]
    lenses = {
        name: (by_prior[:, :, k].reshape(6 * count, 4) / sigma[k], sigma[k])
        for k, name in enumerate(result.names)
    }
    scaled_by = result.report.scaled_by
    metric = adjusted.problem.fixed_distance is None or (scaled_by is not None and scaled_by.sigma_m > 0)
    return Placed(result.names, adjusted.state.cameras, rest, lenses, metric)


def _figures(agreement: Agreement | None) -> dict[str, Any] | None:
    if agreement is None:
        return None
    return {
        "agree": agreement.holds,
        "chi2": round(agreement.chi2, 2),
        "degrees": agreement.degrees,
        "probability": agreement.probability,
        "shift_mm": {name: round(shift, 3) for name, shift in agreement.shift_mm.items()},
    }
