# SPDX-License-Identifier: BSD-3-Clause
"""Block tridiagonal matrices, such as the Hessian of a motion, in which each knot is connected to the next.

A factorization by blocks (Golub and Van Loan, Matrix Computations, section 4.5) solves all right-hand sides at once by
matrix products. LAPACK's banded solver takes each by itself, and is several times slower.
"""

from dataclasses import dataclass

import numpy as np

from camera_node.foundation.arrays import Array

GROUP_SIZE = 24  # scalars in one block of the factorization, at least: fewer, larger products are faster


@dataclass(frozen=True, slots=True)
class BlockTridiagonal:
    """A symmetric matrix of K x K blocks: `diagonal` (K, h, h), and `below` (K - 1, h, h) in row k + 1, column k."""

    diagonal: Array
    below: Array

    @classmethod
    def of_chain(cls, parts: Array) -> "BlockTridiagonal":
        """The sum of overlapping symmetric matrices (K - 1, 2 h, 2 h), each of a block and the next."""
        h = parts.shape[1] // 2
        diagonal = np.zeros((len(parts) + 1, h, h))
        diagonal[:-1] += parts[:, :h, :h]
        diagonal[1:] += parts[:, h:, h:]
        return cls(diagonal, parts[:, h:, :h])

    def add_diagonal(self, added: Array) -> "BlockTridiagonal":
        """The matrix with `added` (K, h) on its diagonal."""
        return BlockTridiagonal(self.diagonal + added[:, :, None] * np.eye(added.shape[1]), self.below)

    def multiply(self, columns: Array) -> Array:
        """The product with columns (K, h, n), of the same shape."""
        product = self.diagonal @ columns
        product[1:] += self.below @ columns[:-1]
        product[:-1] += self.below.mT @ columns[1:]
        return product

    def factorize(self) -> "BlockFactors":
        """Factorize the matrix.

        Raises:
            LinAlgError: it is not positive definite.
        """
        h = self.diagonal.shape[1]
        groups, links = self._group(-(-GROUP_SIZE // h))
        for k, link in enumerate(links):
            # The Cholesky factor of what remains of this group after the elimination of those before.
            groups[k] = np.linalg.cholesky(groups[k])
            if k + 1 < len(groups):
                by_link = np.linalg.solve(groups[k, -h:, -h:], link.T)
                groups[k + 1, :h, :h] -= by_link.T @ by_link
        root = np.linalg.inv(groups)
        inverse = root.mT @ root
        return BlockFactors(inverse, links[:-1] @ inverse[:-1, -h:], len(self.diagonal))

    def _group(self, count: int) -> tuple[Array, Array]:
        """The diagonal in groups (N, m, m) of `count` blocks, padded with ones at the end, of which the part above the
        diagonal is not filled, and the block (N, h, h) that links each to the next; 0 for the last."""
        blocks, h = self.diagonal.shape[:2]
        total = -(-blocks // count)
        diagonal, below = np.tile(np.eye(h), (total * count, 1, 1)), np.zeros((total * count, h, h))
        diagonal[:blocks], below[: blocks - 1] = self.diagonal, self.below
        groups = np.zeros((total, count, h, count, h))
        for k in range(count):
            groups[:, k, :, k] = diagonal[k::count]
            if k:
                groups[:, k, :, k - 1] = below[k - 1 :: count]
        return groups.reshape(total, count * h, count * h), below[count - 1 :: count]


@dataclass(frozen=True, slots=True)
class BlockFactors:
    """L D L^T of a matrix, in N groups of m rows, padded with ones.

    Attributes:
        inverse: (N, m, m) of the blocks of D.
        below: (N - 1, h, m) the first h rows of the blocks of L below its diagonal; the others are 0.
        blocks: number K of the matrix's own blocks, of h rows.
    """

    inverse: Array
    below: Array
    blocks: int

    def solve(self, right: Array) -> Array:
        """The solution for right-hand sides (K, h, n), of the same shape."""
        h, n = right.shape[1:]
        x = np.zeros((*self.inverse.shape[:2], n))
        x.reshape(-1, h, n)[: self.blocks] = right
        for k, below in enumerate(self.below):
            x[k + 1, :h] -= below @ x[k]
        x = self.inverse @ x
        for k in reversed(range(len(self.below))):
            x[k] -= self.below[k].T @ x[k + 1, :h]
        return x.reshape(-1, h, n)[: self.blocks]
