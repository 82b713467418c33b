# SPDX-License-Identifier: BSD-3-Clause
"""Rigid bodies with printed roundels: wands and robots."""

import math

import msgspec
import numpy as np

from camera_node.foundation.arrays import Array
from camera_node.geometry import codes
from camera_node.geometry.pose import rotation_with_z

Vector = tuple[float, float, float]
MAX_EXTENT_M = 10.0  # of a marker's coordinates and of a roundel's diameter
MAX_THICKNESS_M = 0.1  # of a wand with two printed sides
LINE_M = 0.02  # markers within this of a line do not show a rotation about it
UP: Vector = (0.0, 0.0, 1.0)
UNIT = 1e-9  # a normal whose length differs from 1 by less stays as it is, so that a saved body equals its original


class Body(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """Roundels of one size at known positions of a rigid body.

    Attributes:
        diameter_m: outer diameter d_o of the black disc, metres.
        markers: centres of the roundels, body frame, metres.
        normals: directions out of the prints, one for each marker, body frame, scaled to unit vectors; empty if all
            are +z.
        inner_ratio: d_i / d_o, diameter of the white inner disc over d_o; 0.6 in the paper.
        surround_ratio: d / d_o, diameter of the white card over d_o; 9/7 in the paper. Cards of codes are at least as
            large as the code needs.
        code: number of the code around the roundel, or of each marker's, 0 for one without; none unless given.
    """

    diameter_m: float
    markers: tuple[Vector, ...] = ((0.0, 0.0, 0.0),)
    normals: tuple[Vector, ...] = ()
    inner_ratio: float = 0.6
    surround_ratio: float = 9 / 7
    code: int | tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not 0.001 <= self.diameter_m <= MAX_EXTENT_M:
            raise ValueError(f"diameter_m is {self.diameter_m}; give the black disc's diameter d_o in metres")
        self.check_layout()

    def check_layout(self) -> None:
        """Raise ValueError unless the markers' positions and the ratios of diameters are plausible."""
        if not self.markers or not all(abs(x) <= MAX_EXTENT_M for marker in self.markers for x in marker):
            raise ValueError(
                f"markers must be one or more [x, y, z] in metres, each within {MAX_EXTENT_M:g} m"
            )
        if not (0.1 <= self.inner_ratio <= 0.95 and 1.0 <= self.surround_ratio <= 10):
            raise ValueError("inner_ratio must be in [0.1, 0.95] and surround_ratio in [1, 10]")
        self._check_codes()
        self._scale_normals()

    @property
    def codes(self) -> tuple[int, ...]:
        """The code of each marker, 0 for one without."""
        numbers = (self.code,) if isinstance(self.code, int) else self.code
        return numbers or (codes.PLAIN,) * len(self.markers)

    @property
    def code_axes(self) -> Array:
        """(M, 3) unit vectors to the zeros of the codes, body frame: the x axis where a print faces +z."""
        return rotation_with_z(self.unit_normals)[:, :, 0]

    @property
    def needs_headings(self) -> bool:
        """Whether only the zeros of codes show its rotation: its markers are on one line, along all normals.

        Elsewhere positions and normals show it better than a card that a hand has glued on.
        """
        return are_parallel(np.vstack([self.points - self.points[0], self.unit_normals]))

    @property
    def card_ratio(self) -> float:
        """Diameter of the largest card over d_o."""
        return max(self.surround_ratio, codes.CARD) if any(self.codes) else self.surround_ratio

    @property
    def points(self) -> Array:
        """(M, 3) marker centres, body frame, metres."""
        return np.array(self.markers, float)

    @property
    def unit_normals(self) -> Array:
        """(M, 3) directions out of the prints, body frame."""
        return np.array(self.normals or (UP,) * len(self.markers), float)

    def has_markers_of(self, other: "Body") -> bool:
        """Whether both have the same markers, with the same normals and codes."""
        same = self.markers == other.markers and self.normals == other.normals
        return same and self.codes == other.codes

    def _check_codes(self) -> None:
        """Raise ValueError for codes that do not exist, that are there twice, or that are not one for each marker."""
        if len(self.codes) != len(self.markers):
            raise ValueError(
                f"{len(self.codes)} codes for {len(self.markers)} markers; give one for each, 0 for one without"
            )
        used = [number for number in self.codes if number != codes.PLAIN]
        if unknown := [number for number in used if not codes.is_code(number)]:
            raise ValueError(f"there is no code {unknown[0]}; give 1 to {len(codes.words())}")
        if len(set(used)) < len(used):
            raise ValueError("two markers have the same code; print another one for each")

    def _scale_normals(self) -> None:
        """Make unit vectors of the normals; raise ValueError where one has no direction."""
        if self.normals and len(self.normals) != len(self.markers):
            raise ValueError(
                f"{len(self.normals)} normals for {len(self.markers)} markers; give one [x, y, z] for each marker, or "
                "none if all prints face +z"
            )
        normals = tuple(_unit(normal) for normal in self.normals)
        msgspec.structs.force_setattr(self, "normals", () if set(normals) <= {UP} else normals)


def are_parallel(vectors: Array) -> bool:
    """Whether vectors (N, 3), metres or unit vectors, are along one line within `LINE_M`."""
    return bool(np.linalg.matrix_rank(vectors, tol=LINE_M) < 2)


class PrintedWand(Body, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True):
    """A wand for calibration, with roundels on one side, or back to back on both sides.

    Attributes:
        thickness_m: from the prints of one side to those of the other, metres; `markers` are in the middle. 0: one side
            is printed, or both at the same place.
    """

    thickness_m: float = 0.0

    def check_layout(self) -> None:
        """Raise ValueError unless the wand can be calibrated with."""
        super().check_layout()
        if self.normals:
            raise ValueError(
                "a wand has no normals: its prints face one way, or both ways, thickness_m apart; leave normals out"
            )
        if codes.PLAIN in self.codes and any(self.codes):
            raise ValueError(
                "a wand has a code at each of its markers, or at none; print those that are missing"
            )
        if not 0 <= self.thickness_m <= MAX_THICKNESS_M:
            raise ValueError(
                f"thickness_m is {self.thickness_m}; give metres from 0 to {MAX_THICKNESS_M:g}, or leave it out"
            )
        if self.thickness_m and np.linalg.matrix_rank(self.points - self.points[0], tol=0.005) > 1:
            raise ValueError(
                "a wand with two printed sides has its markers on a line; move them, or leave out thickness_m"
            )


def thickness_of(wand: Body) -> float:
    """The distance between the two printed sides of a wand, metres; 0 with one side."""
    return wand.thickness_m if isinstance(wand, PrintedWand) else 0.0


def _unit(v: Vector) -> Vector:
    length = math.hypot(*v)
    if not 1e-6 < length < 1e6:  # False for NaN
        raise ValueError(f"the normal {list(v)} has no direction; give a finite [x, y, z] out of the print")
    x, y, z = v
    return v if abs(length - 1) < UNIT else (x / length, y / length, z / length)
