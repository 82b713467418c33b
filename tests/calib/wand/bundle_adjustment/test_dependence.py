# SPDX-License-Identifier: BSD-3-Clause
"""Covariances count what observations tell, not how many there are: errors that last for a while are found out."""

from collections import Counter

import numpy as np
import pytest

from calib.commands.check import placed, split
from calib.wand.calibrate import calibrate
from calib.wand.outcome import WandCalibration
from calib.wand.quality.agreement import Agreement, compare
from camera_node.arrays import Array
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections
from tests.calib.synthetic import Arena, record, ring

SEEDS = range(4)


def lasting(messages: list[Detections], seed: int) -> list[Detections]:
    """Centres that wander off by 0.3 px RMS, all of a camera alike, with periods of 1 to 4 s."""
    rng = np.random.default_rng(seed)
    names = sorted(Counter(message.camera for message in messages))
    rate = 2 * np.pi / rng.uniform(1, 4, (len(names), 2, 4))
    phase = rng.uniform(0, 2 * np.pi, rate.shape)
    moved = []
    for message in messages:
        k = names.index(message.camera)
        off: Array = 0.3 / np.sqrt(2) * np.sin(rate[k] * message.t_ns * 1e-9 + phase[k]).sum(axis=1)
        seen = message.unpack()
        header = {name: getattr(message, name) for name in ("camera", "seq", "t_ns", "width", "height")}
        moved.append(Detections.pack(Roundels.from_points(seen.uv + off, 0.1, seen.id), **header))
    return moved


def halves(arena: Arena, messages: list[Detections]) -> tuple[list[WandCalibration], Agreement]:
    found = [calibrate(arena.intrinsics, arena.wand, half) for half in split(messages)]
    return found, compare(*map(placed, found))


@pytest.mark.parametrize(("wandering", "expected"), [(False, 1.0), (True, 2.5)])
def test_halves_agree_within_what_is_claimed(wandering: bool, expected: float):
    """Chi-square of the halves' differences, summed over waves: its mean is the degrees of freedom D, its standard
    deviation (2 D)^1/2, of which it keeps 4 where errors are independent; and nothing is widened by more than chance.

    Of errors that last up to 4 s, blocks of 1 s see a part: what is claimed is right within a factor of 2, where
    without widening it was wrong by more than 3.5: lenses that are adjusted take up some of such errors.
    """
    arena, chi2, degrees, plain, factors = ring(3), 0.0, 0, 0.0, []
    for seed in SEEDS:
        messages = record(
            arena, 20.0, sigma_px=0.1, seed=seed, numbered=True, sized=False, free_running=False
        )
        found, told = halves(arena, lasting(messages, seed) if wandering else messages)
        chi2, degrees = chi2 + told.chi2, degrees + told.degrees
        factor = float(np.mean([half.adjusted.inflation for half in found]))
        plain, factors = plain + told.chi2 * factor, [*factors, factor]
    if wandering:
        assert np.mean(factors) > expected
        assert plain / degrees > 3.5**2
        assert chi2 / degrees < 2.0**2
    else:
        assert np.mean(factors) == pytest.approx(expected, abs=0.15)
        assert chi2 == pytest.approx(degrees, abs=4 * np.sqrt(2 * degrees))
