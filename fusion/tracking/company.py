# SPDX-License-Identifier: BSD-3-Clause
"""Decides which unlabeled markers belong to one body: those whose distance stays the same while they move."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from camera_node.foundation.arrays import Array, Mask
from fusion.model.likeness import distances

MOVED_M = 0.05  # since the anchor: far above the noise
CONCLUSIVE_M = (
    0.15  # two markers that moved so far together belong to one body, also after one of them is hidden
)
RIGID_M = 0.01  # largest change of the distance of two markers of one body
BODY_M = 1.0  # largest distance of two markers of one body


@dataclass(frozen=True, slots=True, eq=False)
class Company:
    """What the motion of K markers says about the bodies that they belong to.

    Positions are compared with anchors, positions of one time not long ago. Each frame set that sees both markers of a
    pair, one of which has moved, votes for or against one body: at single times, the distance of two robots that pass
    each other is the same as at the anchor.

    Attributes:
        anchor: (K, 3) NaN for markers that are younger.
        votes: (K, K) for one body less those against it, since the anchor.
        rigid_m: (K, K) how far a pair has moved as one body, 0 as soon as the votes contradict it.
        belonged: (K,) to a body whose other marker was lost from view.
        moved: (K,) since the anchor, as of the last observation.
    """

    anchor: Array
    votes: NDArray[np.int64]
    rigid_m: Array
    belonged: Mask
    moved: Mask

    @classmethod
    def unknown(cls, n: int) -> "Company":
        """Of n new markers."""
        pairs, never = np.zeros((n, n)), np.zeros(n, bool)
        return cls(np.full((n, 3), np.nan), pairs.astype(np.int64), pairs, never, never)

    @property
    def anchored(self) -> Mask:
        """(K,) whose motion can be compared."""
        return np.isfinite(self.anchor[:, 0])

    @property
    def in_company(self) -> Mask:
        """(K,) markers that moved together with another one."""
        return self.belonged | (self.rigid_m > 0).any(1)

    @property
    def alone(self) -> Mask:
        """(K,) markers that moved, none of the others with them."""
        return self.moved & ~self.in_company

    def select(self, rows: NDArray) -> "Company":
        """Of some of the markers, indices; the bodies of the others are remembered."""
        gone = np.ones(len(self.anchor), bool)
        gone[rows] = False
        belonged = self.belonged | (self.rigid_m[:, gone] > CONCLUSIVE_M).any(1)
        pairs = np.ix_(rows, rows)
        return Company(
            self.anchor[rows], self.votes[pairs], self.rigid_m[pairs], belonged[rows], self.moved[rows]
        )

    def with_new(self, n: int) -> "Company":
        """Of these markers, then n new ones."""
        new = Company.unknown(n)
        return Company(
            np.concatenate([self.anchor, new.anchor]),
            np.pad(self.votes, (0, n)),
            np.pad(self.rigid_m, (0, n)),
            np.concatenate([self.belonged, new.belonged]),
            np.concatenate([self.moved, new.moved]),
        )

    def observed(self, p: Array, radius: Array, seen: Mask) -> "Company":
        """With the votes of a frame set.

        Args:
            p: (K, 3) positions, world frame, m.
            radius: (K,) of the markers, m. Two that overlap are one disc that was triangulated twice.
            seen: (K,) in this frame set.
        """
        motion = np.nan_to_num(np.linalg.norm(p - self.anchor, axis=1))
        moved = seen & (motion > MOVED_M)
        if not moved.any():
            return replace(self, moved=moved)
        now = distances(p)
        overlap = now < radius[:, None] + radius
        known = seen & self.anchored
        compared = known[:, None] & known & (moved[:, None] | moved) & ~overlap
        is_rigid = (np.abs(now - distances(self.anchor)) < RIGID_M) & (now < BODY_M)
        votes = self.votes + np.where(compared, np.where(is_rigid, 1, -1), 0)
        pair_m = np.maximum(self.rigid_m, np.maximum(motion[:, None], motion))
        rigid_m = np.where(compared & (votes > 0), pair_m, np.where(votes < 0, 0.0, self.rigid_m))
        return replace(self, votes=votes, rigid_m=rigid_m, moved=moved)

    def anchored_at(self, p: Array) -> "Company":
        """With new anchors, the positions p (K, 3)."""
        return replace(self, anchor=p, votes=np.zeros_like(self.votes), moved=np.zeros(len(p), bool))
