# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate check`: judges a rig by a wand recording."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import msgspec

from calib.commands.inputs import WandOptions
from calib.commands.output import check_folder, provenance, write_rig
from calib.commands.printed_report import print_report, save_maps
from calib.errors import CalibrationError
from calib.rig.rig import Rig, load_rig
from calib.rig.wand_file import load_wand
from calib.wand.calibrate import calibrate
from calib.wand.quality.agreement import Agreement, CameraPoses, compare_calibrations
from calib.wand.quality.grade import assess
from calib.wand.scale import Distance
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.terminal import progress_console, say
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections


@dataclass(frozen=True, kw_only=True)
class Check(WandOptions):
    """Judge a rig by a wand recording: whether the cameras still have the rig's poses, whether two halves of the
    recording agree, how precise the rig is where robots drive, and which camera limits it. Nothing is written without
    --maps or --out."""

    rig: Path
    """The rig to judge."""
    out: Path | None = None
    """Write the rig with the results in its `calibration` to this file."""

    def run(self) -> None:
        """Calibrate from the whole recording and from its halves, and compare."""
        self.require_recording()
        if self.out is not None:
            check_folder(self.out)
        rig, wand = load_rig(self.rig), load_wand(self.wand)
        figures = self._judge(rig, wand, self.read_recording(rig, wand), self.measured_distance(rig))
        if self.out is not None:
            calibration = {**rig.calibration, "check": {**provenance(), **figures}}
            write_rig(msgspec.structs.replace(rig, calibration=calibration), self.out)

    def _judge(
        self, rig: Rig, wand: Body, messages: Sequence[Detections], distance: Distance | None
    ) -> dict[str, Any]:
        with progress_console().status("calibrating camera poses"):
            result = calibrate(rig, wand, messages, distance, self.synchronised)
        quality = assess(result, wand, self.height)
        print_report(result, quality)
        halves = _compare_halves(result, wand, messages, distance)
        with_rig = _compare_with_rig(rig, result)
        if self.maps is not None:
            save_maps(self.maps, result, quality)
        return {**quality.as_dict(), "halves": _figures(halves), "rig": _figures(with_rig)}


def _compare_halves(
    whole: WandCalibration, wand: Body, messages: Sequence[Detections], distance: Distance | None
) -> Agreement | None:
    """Compare calibrations from both halves of a recording.

    Both start from the lenses of the whole recording: a half that refines lenses less would otherwise rotate its
    cameras instead. The error of a measured distance is the same in both.
    """
    exact = distance and replace(distance, sigma_m=0.0)
    try:
        with progress_console().status("calibrating camera poses from each half"):
            first, second = (
                calibrate(whole.rig, wand, half, exact, whole.synchronous) for half in split_halves(messages)
            )
            agreement = compare_calibrations(*(CameraPoses.of_calibration(half) for half in (first, second)))
    except CalibrationError as error:
        say(f"warning: the halves of the recording can't be compared: {error}")
        return None
    say(("" if agreement.holds else "warning: ") + agreement.sentence())
    return agreement


def _compare_with_rig(rig: Rig, result: WandCalibration) -> Agreement | None:
    known = CameraPoses.of_rig(rig)
    if len([name for name in known.names if name in result.names]) < 2:
        say("the rig has no poses with covariances to compare; only the recording was judged")
        return None
    agreement = compare_calibrations(known, CameraPoses.of_calibration(result))
    sentence = agreement.sentence("the rig and the recording")
    advice = "wave the wand again and run roundel calibrate wand"
    say(sentence if agreement.holds else f"warning: {sentence}; {advice}")
    return agreement


def split_halves(messages: Sequence[Detections]) -> tuple[list[Detections], list[Detections]]:
    """The two halves of a recording, by time."""
    times = [message.t_ns for message in messages]
    middle = (min(times) + max(times)) // 2
    return [m for m in messages if m.t_ns <= middle], [m for m in messages if m.t_ns > middle]


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
