# SPDX-License-Identifier: BSD-3-Clause
"""Whether hard recordings are calibrated, and their claims true: `python -m tests.benchmarks.calibration acceptance`.

Figures are those of `calibration_honesty`: mean squared errors in standard deviations, 1 for true claims. Lenses that a
recording does not determine are named, with the interval that is claimed. The cases:

- "cube": eight cameras around a cube with markers on its sides, of which each camera sees two at a time.
- "groups": two groups of two cameras, which see the same cube one after the other.
- "phones": six cameras with offsets of up to 60 s and rates of up to 1 % before one light, their lenses exact. The
  figure of clocks is that of offsets and rates together.
- "lenses": four cameras before a wand, lenses unknown by factors between 1/2 and 2; of each recording two starts. Four
  recordings for one of the other cases: three have clocks of 0.1 to 0.3 by chance, and other three of 2 to 5.

Options: `--seeds N` recordings of each case (3, and 12), `--jobs N` processes (1), `--cases NAME ...`, and `--layout
caliscope | argus | dltdv`: each recording is written as that program writes it and imported.
"""

import argparse
import contextlib
import io
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
from rich.console import Console

from calib.commands.formats import FormatName, ImportData
from calib.errors import CalibrationError
from calib.rig.camera import DRIFT, OFFSET
from calib.rig.rig import Rig, load_rig
from calib.wand.bundle_adjustment.covariance import camera_covariance
from calib.wand.calibrate import calibrate
from calib.wand.quality.grade import assess
from calib.wand.quality.lenses import describe_open_lenses
from calib.wand.wand_report import WandCalibration
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import track
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections
from camera_node.sources.recorded_detections import read_observations
from tests.benchmarks.calibration_honesty import (
    FIGURES,
    LIGHT,
    Outcome,
    compute,
    error_of_differences,
    judge,
    report,
    without_lenses,
)
from tests.calib.cube import CUBE, one_after_the_other, wave
from tests.calib.foreign_layouts import LAYOUTS
from tests.calib.recordings import EPOCH_S, WandScenario, record, with_clocks
from tests.calib.synthetic import CAREFUL, EXACT, WAND, ring, roughly

STARTS, RECORDINGS = 2, 4  # of each recording with unknown lenses, and those for one of the other cases
SECONDS, RATE_HZ = 30.0, 20.0  # of a recording of phones, or with unknown lenses
MIDDLE_NS = round(1e9 * (EPOCH_S + SECONDS / 2))
MAX_OFFSET_S, MAX_RATE = 60.0, 0.01


@dataclass(frozen=True)
class Recorded:
    """A recording, the rig before it, whose lenses may be guesses, and the truth, with the offset, s, and the rate of
    each camera's clock where these are judged."""

    rig: Rig
    wand: Body
    messages: Sequence[Detections]
    truth: Rig
    synchronous: bool = False
    clocks: Mapping[str, tuple[float, float]] | None = None
    guessed: bool = False

    def through(self, layout: FormatName) -> "Recorded":
        """The same, written as another program writes it and imported; its user guesses lenses again, others have no
        standard deviations in these layouts.

        Raises:
            CalibrationError: the layout has no times, and the cameras run freely.
        """
        if layout != "caliscope" and not self.synchronous:
            raise CalibrationError(f"{layout} has no times")
        with tempfile.TemporaryDirectory() as name, contextlib.redirect_stdout(io.StringIO()):
            folder = Path(name)
            files = LAYOUTS[layout](folder, self.rig, self.wand, self.messages)
            ImportData(format=layout, files=files, out=folder).run()
            rig = load_rig(folder / "rig.yaml")
            sizes = {camera: (lens.width, lens.height) for camera, lens in rig.cameras.items()}
            messages = read_observations(folder / "observations.csv", sizes, fps=RATE_HZ)
        named = dict(zip(self.rig.cameras, rig.cameras, strict=True))
        return replace(
            self,
            rig=Rig(cameras={named[k]: c for k, c in self.rig.cameras.items()}) if self.guessed else rig,
            messages=messages,
            truth=Rig(cameras={named[k]: camera for k, camera in self.truth.cameras.items()}),
            clocks=self.clocks and {named[k]: clock for k, clock in self.clocks.items()},
        )


def cube(seed: int) -> Recorded:
    """Forty simultaneous frames."""
    arena = ring(8, wand=CUBE)
    rig = roughly(arena.intrinsics, CAREFUL, with_sigma=True, seed=seed)
    return Recorded(rig, CUBE, wave(arena, 2, 40, seed), arena.truth, synchronous=True)


def groups(seed: int) -> Recorded:
    """Two hundred frames of each camera, which run freely."""
    arena, messages = one_after_the_other((2, 2), 200, seed)
    rig = roughly(arena.intrinsics, CAREFUL, with_sigma=True, seed=seed)
    return Recorded(rig, CUBE, messages, arena.truth)


def scenario(seed: int, **options: object) -> WandScenario:
    """A recording of cameras that run freely."""
    header = {"seconds": SECONDS, "rate_hz": RATE_HZ, "sigma_px": 0.2, "outliers": 0.02, "drift_ppm": 0.0}
    seen = {"numbered": True, "sized": False, "both_sides": True}
    return WandScenario(**{**header, **seen, "seed": seed, **options})


def phones(seed: int) -> Recorded:
    """Each clock has an offset and a rate; one is right."""
    recorded = record(scenario(seed, cameras=6, wand=LIGHT, offset_ms=0.0))
    names, rng = list(recorded.truth.cameras), np.random.default_rng([13, seed])
    drawn = rng.uniform(-1, 1, (len(names), 2)) * [MAX_OFFSET_S, MAX_RATE]
    drawn[0] = 0.0
    clocks = dict(zip(names, drawn.tolist(), strict=True))
    rig = roughly(recorded.intrinsics, EXACT, with_sigma=True)  # a light determines no lenses
    return Recorded(
        rig, LIGHT, with_clocks(recorded.messages, MIDDLE_NS, clocks), recorded.truth, clocks=clocks
    )


def lenses(seed: int) -> Recorded:
    """Focal lengths start from another random factor in each camera."""
    recorded = record(scenario(seed // STARTS, cameras=4, offset_ms=50.0))
    rig = without_lenses(recorded.intrinsics, seed)
    return Recorded(rig, WAND, recorded.messages, recorded.truth, guessed=True)


def map_error(result: WandCalibration, clocks: Mapping[str, tuple[float, float]]) -> float:
    """Squared Mahalanobis error of all offsets and rates, over its degrees of freedom; a common offset and a common
    rate are not observable.

    Args:
        clocks: offset, s, and rate of each camera's stamps, as of `with_clocks`.
    """
    late = []
    for name in result.names:
        offset_s, rate = clocks[name]
        stamps = [MIDDLE_NS + round(1e9 * (t_s * (1 + rate) + offset_s)) for t_s in (-1.0, 1.0)]
        before, after = (
            1e-9 * (result.rig.cameras[name].capture_ns(stamp) - MIDDLE_NS) - t_s
            for stamp, t_s in zip(stamps, (-1.0, 1.0), strict=True)
        )
        late.append([(before + after) / 2, (after - before) / 2])
    covariance = camera_covariance(result.adjusted).of(OFFSET + DRIFT)
    common = np.tile(np.eye(2), (len(late), 1))
    return error_of_differences(np.ravel(late), covariance.reshape(2 * len(late), -1), common)


CASES: dict[str, Callable[[int], Recorded]] = {
    "cube": cube,
    "groups": groups,
    "phones": phones,
    "lenses": lenses,
}


def measure(case: str, seed: int, layout: FormatName | None = None) -> Outcome:
    """The outcome of a case with a seed, or why it was refused; through the files of a layout if that is given."""
    try:
        given = CASES[case](seed)
        given = given.through(layout) if layout else given
        result = calibrate(given.rig, given.wand, given.messages, synchronous=given.synchronous)
    except (CalibrationError, ConfigError) as error:
        return Outcome(case, seed, fault=str(error))
    outcome = judge(case, seed, result, given.truth)
    if given.clocks is not None:
        outcome = msgspec.structs.replace(outcome, clocks=map_error(result, given.clocks), focal=None)
    fault = describe_open_lenses(assess(result, given.wand).open_lenses) if case == "lenses" else ""
    return msgspec.structs.replace(outcome, fault=fault)


def of_recordings(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The outcomes, those of all starts of one recording with their means: starts are no independent samples."""
    own = [outcome for outcome in outcomes if outcome.cell != "lenses"]
    starts: dict[int, list[Outcome]] = {}
    for outcome in outcomes[len(own) :]:
        starts.setdefault(outcome.seed // STARTS, []).append(outcome)
    for number, several in starts.items():
        known = {f: [v for o in several if (v := getattr(o, f)) is not None] for f in FIGURES}
        means = {figure: float(np.mean(values)) for figure, values in known.items() if values}
        faults = Counter(outcome.fault for outcome in several if outcome.fault)
        fault = "; ".join(f"{count} of {len(several)} starts: {text}" for text, count in faults.items())
        own.append(Outcome("lenses", number, fault=fault, **means))
    return own


def run(arguments: list[str]) -> None:
    """Print a row for each case; figures outside of 0.6 to 1.6 are marked."""
    parser = argparse.ArgumentParser(prog="tests.benchmarks.calibration acceptance")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--cases", nargs="*", choices=CASES, default=list(CASES))
    parser.add_argument("--layout", choices=LAYOUTS)
    options = parser.parse_args(arguments)
    options.cases.sort(key=list(CASES).index)
    start = time.monotonic()
    count = {case: options.seeds * (STARTS * RECORDINGS if case == "lenses" else 1) for case in options.cases}
    tasks = [(case, seed) for case, seeds in count.items() for seed in range(seeds)]
    outcomes = list(
        track(
            compute(partial(measure, layout=options.layout), tasks, options.jobs), "calibrating", len(tasks)
        )
    )
    report(of_recordings(sorted(outcomes, key=lambda outcome: tasks.index((outcome.cell, outcome.seed)))))
    Console().print(f"{len(tasks)} calibrations in {time.monotonic() - start:.0f} s")
