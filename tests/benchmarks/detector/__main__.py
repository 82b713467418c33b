# SPDX-License-Identifier: BSD-3-Clause
"""Measures detectors and compares each figure with its goal: `python -m tests.benchmarks.detector [PART ...]`."""

import sys
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Literal

import tyro
from rich.console import Console

from camera_node.detection.detector import Detector
from camera_node.foundation.errors import ConfigError
from tests.benchmarks.detector import (
    accuracy,
    bent,
    cameras,
    known_lens,
    lighting,
    models,
    motion,
    negatives,
    pose,
    recall,
    speed,
)
from tests.benchmarks.detector.second import measurement
from tests.benchmarks.detector.table import Run, print_verdicts

PARTS = {
    "speed": speed.measure,
    "accuracy": accuracy.measure,
    "known_lens": known_lens.measure,
    "recall": recall.measure,
    "motion": motion.measure,
    "false_positives": negatives.measure,
    "pose": pose.measure,
    "cameras": cameras.measure,
    "lighting": lighting.measure,
    "bent": bent.measure,
    "second": measurement.measure,
    "attack": models.measure,
}


@dataclass(frozen=True)
class Benchmark:
    """Measure detectors against their goals. All random numbers are seeded; times depend on the machine."""

    parts: Annotated[
        tuple[
            Literal[
                "speed",
                "accuracy",
                "known_lens",
                "recall",
                "motion",
                "false_positives",
                "pose",
                "cameras",
                "lighting",
                "bent",
                "second",
                "attack",
                "all",
            ],
            ...,
        ],
        tyro.conf.Positional,
    ] = ("all",)
    """The parts to measure."""
    detector: tuple[str, ...] = ("chords",)
    """The detectors to measure: values of `Detector(detector=...)`."""
    thorough: bool = False
    """Measure the whole grid with many more draws; takes hours instead of two minutes."""
    seed: int = 0
    """Other pictures for `attack`."""
    quick: bool = False
    """Fewer pictures in `attack`: about two minutes of one core."""

    def run(self) -> None:
        """Print the tables and goals of each detector."""
        console = Console(width=None if sys.stdout.isatty() else 140)
        parts = PARTS if "all" in self.parts else {name: PARTS[name] for name in dict.fromkeys(self.parts)}
        for name in self.detector:
            make = partial(Detector, detector=name)  # pyright: ignore[reportArgumentType] checked when called
            try:
                make()
            except ConfigError as error:
                console.print(f"{name}: not measured, {error}")
                continue
            run = Run(name, make, self.thorough, self.seed, self.quick)
            print_verdicts(console, name, [v for measure in parts.values() for v in measure(run, console)])


if __name__ == "__main__":
    tyro.cli(Benchmark, prog="tests.benchmarks.detector").run()
