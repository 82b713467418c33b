# SPDX-License-Identifier: BSD-3-Clause
"""`python -m tests.benchmarks.relative`: localization by one camera.

1. Are covariances and probabilities honest? Ray-traced pictures by size and slant; columns: mean of the squared
   Mahalanobis distance of the position (3 is right), RMS error of the right normal over its claimed one (1 is right;
   the claim is for the less certain of two directions), how often the more probable normal is the right one against
   its mean probability, and RMS error of the distance by the full fit and by the principal axis.
2. Do three robots hold their formation for five minutes under changing light, by relative localization alone?
"""

import time
from collections.abc import Iterator
from typing import Literal

import cv2
import numpy as np
import tyro

from camera_node.detection.detector import Detector
from camera_node.detection.relative_positions import DiscLocalizer
from camera_node.detection.roundels import LocatedRoundels
from camera_node.geometry.lens import Lens
from formation.live_formation import FormationScore
from tests.camera_node.tracing import Sight, expose, pixels_across, trace
from tests.examples.lockstep import run_lockstep

DIAMETER_M, FOCAL_PX, NOISE = 0.1, 600.0, 2.5
SIZES_PX, SLANTS_DEG = (14, 20, 40, 80), (0, 5, 10, 20, 35, 60)
POSES, PICTURES = 12, 10
REPORT_S = 20.0


def main(
    seconds: float = 300.0, seeds: tuple[int, ...] = (0,), only: Literal["", "precision", "formation"] = ""
) -> None:
    """Print both parts.

    Args:
        seconds: simulated duration of each formation.
        seeds: of the formations.
        only: "precision" or "formation"; both unless given.
    """
    cv2.setNumThreads(1)
    if only != "formation":
        report_precision()
    if only != "precision":
        for seed in seeds:
            report_formation(seconds, seed)


def report_precision() -> None:
    print("px  slant    n  chi2  normal  right %  claimed %  distance %  by axis %")
    for px in SIZES_PX:
        for slant in SLANTS_DEG:
            rows = np.array([measure(sight, found) for sight, found in pictures(px, slant)])
            chi2, normal, right, claimed, full, axis = rows.T
            apart = np.isfinite(right)  # both normals differ
            shares = f"{percent(right[apart])}  {percent(claimed[apart])}"
            errors = f"{100 * rms(full):10.4f} {100 * rms(axis):10.4f}"
            line = f"{px:2d}  {slant:5d}  {len(rows):3d}  {chi2.mean():4.2f}  {rms(normal):6.2f}"
            print(f"{line}  {shares}  {errors}", flush=True)


def pictures(px: float, slant_deg: float) -> Iterator[tuple[Sight, LocatedRoundels]]:
    """Ray-traced pictures in which the roundel was found."""
    rng, half = np.random.default_rng(round(100 * px + slant_deg)), round(0.75 * px) + 8
    size = {"width": 2 * half, "height": 2 * half, "cx": half + 120.0, "cy": half - 90.0}
    lens = Lens(fx=FOCAL_PX, fy=FOCAL_PX, **size)
    for turn in rng.uniform(0, 2 * np.pi, POSES):
        u, v = half + rng.uniform(-0.5, 0.5, 2)
        distance = pixels_across(lens, DIAMETER_M, px)
        sight = Sight(lens, (u, v), distance, DIAMETER_M, tilt=np.radians(slant_deg), turn=turn)
        clean = trace(sight, 4)
        for _ in range(PICTURES):
            found = DiscLocalizer(lens, DIAMETER_M).locate(Detector().detect(expose(clean, NOISE, rng)))
            if len(found) == 1:
                yield sight, found


def measure(sight: Sight, found: LocatedRoundels) -> tuple[float, ...]:
    """chi2, error of the normal over the claim, right, claimed probability, errors of both distances over the distance.

    `right` is NaN where both normals are equal.
    """
    e, distance = found.position[0] - sight.position, float(np.linalg.norm(sight.position))
    cosines = found.normals[0] @ sight.normal
    k = int(np.argmax(cosines))
    error = float(np.arccos(np.clip(cosines[k], -1, 1))) / np.sqrt(2)  # of each of two directions
    equal = found.normals[0, 0] @ found.normals[0, 1] > np.cos(np.radians(0.5))
    return (
        float(e @ np.linalg.solve(found.cov[0], e)),
        error / float(found.normal_sigma[0, k]),
        float("nan") if equal else float(k == 0),
        float(found.probability[0, 0]),
        float(np.linalg.norm(found.position[0])) / distance - 1,
        float(found.axis_distance[0]) / distance - 1,
    )


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def percent(values: np.ndarray) -> str:
    return f"{100 * values.mean():7.1f}" if len(values) else "      -"


def report_formation(seconds: float, seed: int) -> None:
    begun, reported, score = time.process_time(), 0.0, FormationScore()
    for t_s, score in run_lockstep(seconds, seed):
        if t_s - reported >= REPORT_S:
            reported = t_s
            largest = 1e3 * score.largest_error_m
            print(f"seed {seed}, {t_s:.0f} of {seconds:.0f} s: largest error {largest:.1f} mm", flush=True)
    print(f"formation, seed {seed}, {seconds:.0f} s, {time.process_time() - begun:.0f} s of processor time")
    print(*score.summarize(), sep="\n")
    print("; ".join(score.faults()) or "PASSED: no collision, and all distances within 20 mm", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
