# SPDX-License-Identifier: BSD-3-Clause
"""Block tridiagonal matrices, against the same matrices written out."""

import numpy as np
import pytest

from calib.wand.bundle_adjustment.optimizer import BlockTridiagonal
from camera_node.foundation.arrays import Array

SIZES = [(6, 2), (6, 21), (12, 7), (24, 5)]  # scalars of a block, and blocks


def random_chain(h: int, blocks: int) -> tuple[BlockTridiagonal, Array]:
    """A positive definite matrix with a condition number of up to 1e8, and the same written out."""
    rng = np.random.default_rng([h, blocks])
    J = rng.standard_normal((blocks - 1, 3 * h, 2 * h)) * np.geomspace(1, 1e-4, 2 * h)
    dense = np.zeros((blocks * h, blocks * h))
    for k, part in enumerate(J.mT @ J):
        dense[k * h : (k + 2) * h, k * h : (k + 2) * h] += part
    return BlockTridiagonal.of_chain(J.mT @ J), dense


@pytest.mark.parametrize(("h", "blocks"), SIZES)
def test_products_and_solutions_are_those_of_the_matrix(h: int, blocks: int):
    """The relative residual of a backward stable solution is some rounding errors (2e-16) times the condition."""
    matrix, dense = random_chain(h, blocks)
    columns = np.random.default_rng(0).standard_normal((blocks, h, 5))
    flat = columns.reshape(-1, 5)
    assert matrix.multiply(columns).reshape(-1, 5) == pytest.approx(
        dense @ flat, abs=1e-12 * np.abs(dense).max()
    )
    factors = matrix.factorize()
    solved, whitened = factors.solve(columns).reshape(-1, 5), factors.whiten(columns).reshape(-1, 5)
    expected = np.linalg.solve(dense, flat)
    tolerance = 100 * np.finfo(float).eps * np.linalg.cond(dense)
    assert np.linalg.norm(solved - expected) < tolerance * np.linalg.norm(expected)
    squared = flat.T @ expected
    assert np.linalg.norm(whitened.T @ whitened - squared) < tolerance * np.linalg.norm(squared)


@pytest.mark.parametrize("block", [0, 4, -1])
def test_a_matrix_that_is_not_positive_definite_is_refused(block: int):
    matrix, _ = random_chain(6, 8)
    diagonal = matrix.diagonal.copy()
    diagonal[block] = -diagonal[block]
    with pytest.raises(np.linalg.LinAlgError):
        BlockTridiagonal(diagonal, matrix.below).factorize()
