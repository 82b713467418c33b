# SPDX-License-Identifier: BSD-3-Clause
"""Fits of hypotheses with given costs."""

from dataclasses import replace

import numpy as np

from fusion.rig_graph.hypotheses import ERRORS, Fit, Hypothesis


def fitted(
    cause: str | None, cameras: tuple[int, ...], n_cameras: int, cost: float, scale: float = 1.0
) -> Fit:
    """A fit of 400 observations with this cost, which show nothing of the cameras' errors."""
    hypothesis = Hypothesis.of(cause, cameras, n_cameras)  # pyright: ignore[reportArgumentType]
    empty, n = np.zeros((0, 0)), n_cameras * ERRORS
    found = np.zeros((n_cameras, ERRORS)), np.zeros((0, 12)), np.zeros((0, 3)), np.eye(n) / scale**2
    reduced, penalty = np.zeros((n, n + 1)), float(hypothesis.free.sum() * np.log(800))
    hypothesis = replace(hypothesis, scale=scale)
    return Fit(hypothesis, cost, penalty, *found, reduced, empty, empty, empty, np.full(400, 1.0))
