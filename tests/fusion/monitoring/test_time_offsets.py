# SPDX-License-Identifier: BSD-3-Clause
"""The time offsets of cameras: elimination of the robots' states, body by body."""

import numpy as np

from camera_node.foundation.arrays import Array, Index
from fusion.monitoring.clocks.time_offsets import FREE, OffsetEquations

CAMERAS, BODIES, K = 5, 7, len(FREE)


def dense(D: Array, body: Index, camera: Index) -> tuple[Array, Array]:
    """The rows (2 N, 9 B + 3 C) and right sides of all unknowns together, as in docs/design/time_offsets.md."""
    J = np.zeros((len(D), 2, K * BODIES + 3 * CAMERAS))
    for n, (b, c) in enumerate(zip(body, camera, strict=True)):
        J[n, :, K * b : K * b + K] = D[n, :, :K]
        first = K * BODIES
        shifts = first + CAMERAS + 2 * c
        J[n][:, [first + c, shifts, shifts + 1]] = D[n, :, K:-1]
    return J.reshape(2 * len(D), -1), D[:, :, -1].reshape(-1)


def test_bodies_are_eliminated_one_by_one_as_all_together():
    """The normal equations without the states, and the residuals of the solution, are those of dense algebra."""
    rng = np.random.default_rng(3)
    n = 60  # some bodies are seen by some cameras several times, some by none
    D, weights = rng.standard_normal((n, 2, K + 4)), rng.uniform(0.1, 1.0, n)
    body, camera = rng.integers(BODIES, size=n), rng.integers(CAMERAS, size=n)
    prior, by_camera = rng.uniform(0.5, 2.0, K), rng.uniform(0.5, 2.0, 3 * CAMERAS)
    equations = OffsetEquations.of(D, body, camera, CAMERAS)
    order = np.argsort(body * CAMERAS + camera)  # of equations.D
    assert np.array_equal(equations.D, D[order])
    reduced, by_pose = equations.eliminate(weights[order], prior)

    J, e = dense(D, body, camera)
    w = np.repeat(weights, 2)
    H, right = (J.T * w) @ J, (J.T * w) @ e
    k = K * BODIES
    H[np.arange(k), np.arange(k)] += np.tile(prior, BODIES)
    solved = np.linalg.solve(H[:k, :k], np.column_stack([H[:k, k:], right[:k]]))
    expected = np.column_stack([H[k:, k:], right[k:]]) - H[k:, :k] @ solved
    np.testing.assert_allclose(reduced, expected, atol=1e-11)

    x = np.asarray(np.linalg.solve(H + np.diag(np.concatenate([np.zeros(k), by_camera])), right), float)
    states = by_pose[:, :, -1] - by_pose[:, :, :-1] @ x[k:]
    squared = equations.squared_residuals(x[k:], states)
    np.testing.assert_allclose(squared, np.sum((e - J @ x).reshape(-1, 2) ** 2, 1)[order], rtol=1e-9)
