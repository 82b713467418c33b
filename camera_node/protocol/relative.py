# SPDX-License-Identifier: BSD-3-Clause
"""Defines the message of a camera that locates roundels by itself: positions in the camera's frame."""

import math

import msgspec
import numpy as np

from camera_node.detection.relative import DIAMETERS_M, LocatedRoundels
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import is_name
from camera_node.protocol.messages import F4, F8, I4, VERSION, MessageError

MAX_POSITIONS = 256  # in one message; messages with more are refused
MAX_DISTANCE_M = 1e4
NORM_ERROR = 1e-3  # of a unit normal; float32 and other programs round
COLUMNS = {  # type and number of values in each row
    "position": (F8, 3),
    "cov": (F8, 6),
    "normals": (F4, 6),
    "probability": (F4, 1),
    "normal_sigma": (F4, 2),
    "axis_distance": (F4, 1),
    "id": (I4, 1),
    "track": (I4, 1),
}
UPPER = np.triu_indices(3)  # xx, xy, xz, yy, yz, zz


class RelativePositions(msgspec.Struct, frozen=True, kw_only=True):
    """The roundels of one frame relative to the camera. `camera`, `seq` and the times are those of its `Detections`.

    Columns with one row for each roundel, as in `LocatedRoundels`: `position` (N, 3) <f8; `cov` (N, 6) <f8 xx, xy, xz,
    yy, yz, zz; `normals` (N, 2, 3) <f4; `probability` (N,) <f4 of the first normal; `normal_sigma` (N, 2) <f4;
    `axis_distance` (N,) <f4; `id` and `track` (N,) <i4, -1 for none.
    """

    version: int = VERSION
    camera: str
    seq: int
    t_ns: int
    exposure_us: float = 0.0
    sent_ns: int = 0
    clock_error_us: float = 0.0
    diameter_m: float
    position: bytes
    cov: bytes
    normals: bytes
    probability: bytes
    normal_sigma: bytes
    axis_distance: bytes
    id: bytes
    track: bytes

    @classmethod
    def pack(cls, located: LocatedRoundels, **header) -> "RelativePositions":
        """Build a message from `located`; `header` contains the fields that are not columns."""
        columns = {name: getattr(located, name) for name in COLUMNS}
        columns["cov"] = located.cov[:, *UPPER]
        columns["probability"] = located.probability[:, 0]
        return cls(**{name: columns[name].astype(COLUMNS[name][0]).tobytes() for name in COLUMNS}, **header)

    def __len__(self) -> int:
        return len(self.position) // 24

    @np.errstate(invalid="ignore")  # the conversion turns signalling NaNs into quiet ones
    def unpack(self) -> LocatedRoundels:
        """Convert the columns to arrays."""
        columns = {name: self._column(name) for name in COLUMNS}
        columns["cov"] = self._covariances()
        columns["normals"] = columns["normals"].reshape(-1, 2, 3)
        first = columns["probability"]
        columns["probability"] = np.stack([first, 1 - first], axis=1)
        return LocatedRoundels(**columns)

    def _column(self, name: str) -> np.ndarray:
        dtype, width = COLUMNS[name]
        column = np.frombuffer(getattr(self, name), dtype).astype(np.int32 if dtype is I4 else float)
        return column if width == 1 else column.reshape(-1, width)

    def _covariances(self) -> Array:
        values = self._column("cov")
        cov = np.empty((len(values), 3, 3))
        cov[:, UPPER[0], UPPER[1]] = cov[:, UPPER[1], UPPER[0]] = values
        return cov

    @np.errstate(invalid="ignore", over="ignore")  # as in `unpack`
    def check(self) -> None:
        """Raise MessageError unless sizes agree, and positions, covariances, normals and probabilities are possible."""
        n = len(self)
        if n > MAX_POSITIONS:
            raise MessageError(f"{n} roundels; a message has at most {MAX_POSITIONS}")
        for name, (dtype, width) in COLUMNS.items():
            size = len(getattr(self, name))
            if size != n * width * dtype.itemsize:
                raise MessageError(f"column {name} of {size} bytes for {n} roundels")
        self._check_header()
        self._check_positions()
        normals = self._column("normals").reshape(-1, 3)  # comparisons with NaN are False
        if not (np.abs(np.linalg.norm(normals, axis=1) - 1) < NORM_ERROR).all():
            raise MessageError("a normal is not of length 1")
        probability = self._column("probability")
        sigma = self._column("normal_sigma")
        if not ((probability >= 0) & (probability <= 1)).all() or not (sigma >= 0).all():
            raise MessageError("a probability is not in [0, 1], or a standard deviation not above 0")

    def _check_positions(self) -> None:
        if not (np.abs(self._column("position")) < MAX_DISTANCE_M).all():
            raise MessageError("a position is NaN or out of range")
        cov = self._covariances()
        if not (np.abs(cov) < MAX_DISTANCE_M**2).all() or not (np.linalg.eigvalsh(cov) > 0).all():
            raise MessageError("a covariance is not positive definite, or out of range")
        distance = self._column("axis_distance")
        if not (np.isnan(distance) | ((distance > 0) & (distance < MAX_DISTANCE_M))).all():
            raise MessageError("a distance is out of range")

    def _check_header(self) -> None:
        if not (is_name(self.camera) and DIAMETERS_M[0] <= self.diameter_m <= DIAMETERS_M[1]):
            raise MessageError("an invalid camera name, or an impossible diameter")
        if not (0 <= self.t_ns < 2**63 and math.isfinite(self.exposure_us)):
            raise MessageError("an impossible t_ns or exposure_us")
        if self.clock_error_us < 0 or math.isinf(self.clock_error_us):
            raise MessageError("an impossible clock_error_us")
