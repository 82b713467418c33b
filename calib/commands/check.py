# SPDX-License-Identifier: BSD-3-Clause
"""`calib check`: whether a rig can be trusted, by a recording of a waved wand."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from calib.commands.choice import require_one
from calib.commands.output import check_folder, provenance, save_maps, say, write_rig
from calib.commands.recording import read_recording
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


@dataclass(frozen=True, kw_only=True)
class Check:
    """Judge a rig by a recording of a waved wand: does it still stand as it says, do two halves agree, how precise is
    it where robots drive, and which camera is the weakest. Nothing is written unless --maps or --out ask for it."""

    rig: Path
    """The rig to judge."""
    wand: Path = Path("configs/wand.yaml")
    """The wand that was waved: diameter_m and markers, metres."""
    frames: Path | None = None
    """Detect in <FOLDER>/<camera>/<t_ns>.png|jpg."""
    observations: Path | None = None
    """Or take marker centres from a CSV: t_ns,camera,u,v[,marker]."""
    recording: Path | None = None
    """Or take what calib wand --live kept, or python -m fusion record wrote (MCAP)."""
    distance: tuple[str, str, float] | None = None
    """Two cameras and the metres between their lenses: the scale for a wand of one marker, else a check of the wand."""
    distance_sigma: float = SIGMA_M
    """Standard deviation of that distance, metres."""
    height: float = 0.1
    """Metres above the floor at which robots carry their roundels."""
    maps: Path | None = None
    """A folder for pictures: each camera's residuals and where to wave next, and the errors to expect."""
    out: Path | None = None
    """Write the rig again, with what was found in its `calibration`."""

    def execute(self, console: Console) -> None:
        """Calibrate anew, whole and in halves, and compare."""
        frames, observations, recording = self.frames, self.observations, self.recording
        require_one(
            {"--frames FOLDER": frames, "--observations CSV": observations, "--recording MCAP": recording}
        )
        if self.out is not None:
            check_folder(self.out)
        rig, wand = load_rig(self.rig), load_yaml(self.wand, Body)
        distance = Distance.of(self.distance, self.distance_sigma, list(rig.cameras))
        messages = read_recording(rig, self.frames, self.observations, wand, self.recording)
        said = self._judge(rig, wand, messages, distance, console)
        if self.out is not None:
            told = {**rig.calibration, "check": {**provenance(), **said}}
            write_rig(msgspec.structs.replace(rig, calibration=told), self.out, console)

    def _judge(
        self,
        rig: Rig,
        wand: Body,
        messages: Sequence[Detections],
        distance: Distance | None,
        console: Console,
    ) -> dict[str, Any]:
        with console.status("placing cameras"):
            result = calibrate(rig, wand, messages, distance)
        trust = assess(result, wand, self.height)
        print_report(result, trust, console)
        halves = _compare_halves(result.rig, wand, messages, distance, console)
        stands = _compare_with_rig(rig, result, console)
        if self.maps is not None:
            save_maps(self.maps, result, trust, console)
        return {**trust.as_dict(), "halves": _figures(halves), "rig": _figures(stands)}


def _compare_halves(
    rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None, console: Console
) -> Agreement | None:
    """Both halves start from the lenses that the whole recording gave: where these were refined, a half that refines
    them less would turn its cameras instead. What is not known of a measured distance is the same in both."""
    same = distance and replace(distance, sigma_m=0.0)
    try:
        with console.status("placing cameras by each half"):
            first, second = (calibrate(rig, wand, half, same) for half in split(messages))
            agreement = compare(placed(first), placed(second))
    except CalibrationError as error:
        say(console, f"warning: the halves of the recording can't be compared: {error}")
        return None
    say(console, ("" if agreement.holds else "warning: ") + agreement.sentence())
    return agreement


def _compare_with_rig(rig: Rig, result: WandCalibration, console: Console) -> Agreement | None:
    known = Placed.of_rig(rig)
    if len([name for name in known.names if name in result.names]) < 2:
        say(console, "the rig has no places with covariances to compare; the recording alone was judged")
        return None
    agreement = compare(known, placed(result))
    advice = "" if agreement.holds else "; wave the wand again and run python -m calib wand"
    say(
        console,
        ("" if agreement.holds else "warning: ") + agreement.sentence("the rig and the recording") + advice,
    )
    return agreement


def split(messages: Sequence[Detections]) -> tuple[list[Detections], list[Detections]]:
    """The two halves of a recording, by time."""
    times = [message.t_ns for message in messages]
    middle = (min(times) + max(times)) // 2
    return [m for m in messages if m.t_ns <= middle], [m for m in messages if m.t_ns > middle]


def placed(result: WandCalibration) -> Placed:
    """The cameras of a calibration, for comparing."""
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
