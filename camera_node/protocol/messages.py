# SPDX-License-Identifier: BSD-3-Clause
"""Defines the messages of a camera: MessagePack maps with arrays as little-endian binary columns, and Zenoh keys."""

import math
import threading
from collections.abc import Mapping
from typing import Any, ClassVar, TypeVar

import msgspec
import numpy as np

from camera_node import _core
from camera_node.detection.roundels import DIAMETERS_M, LocatedRoundels, Roundels
from camera_node.foundation.arrays import Array
from camera_node.foundation.config import is_name, require_name

VERSION = 1
# Of a message, unless its class has a MAX_BYTES of its own. The largest are pictures; a frame with the most roundels
# has 0.3 MB.
MAX_BYTES = 1 << 22
MAX_ROUNDELS = 4096  # in one frame; messages with more are refused
MAX_POSITIONS = 256  # in one message of relative positions; messages with more are refused
MAX_DISTANCE_M = 1e4
NORM_ERROR = 1e-3  # of a unit normal; float32 and other programs round
MAX_RATIOS = 16  # kinds of prints of one camera
MAX_PREVIEW_BYTES, MAX_PREVIEW_SIDE = 1 << 16, 1024  # of a small picture; its side in pixels
MAX_CONTROLS, MAX_CONTROL = 64, 64  # controls of one camera; characters of a name or of a text
MAX_READOUT_US = 1e6  # a frame takes no longer
MAX_VARIANCE_PX2 = 1e4  # of a centre's coordinate; larger ones carry no information
F8, F4, I4 = np.dtype("<f8"), np.dtype("<f4"), np.dtype("<i4")
UPPER = np.triu_indices(3)  # xx, xy, xz, yy, yz, zz
JPEG_START = b"\xff\xd8"
JPEG_SIZE_MARKERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # start of frame, ITU-T T.81 table B.1
JPEG_SIZE_BYTES = 9  # of a start of frame until its width
T = TypeVar("T", bound=msgspec.Struct)
ControlValue = bool | int | float | str  # of a camera's control, such as focus_absolute or TriggerMode


class Keys:
    """Zenoh keys of one arena; `docs/messages.md` lists them. Raises ConfigError if its name is invalid."""

    def __init__(self, arena: str) -> None:
        self.arena = arena = require_name(arena, "an arena")
        self.clock = f"{arena}/clock"  # queryable of the server: the server's time
        self.rig = f"{arena}/rig"
        self.markers = f"{arena}/markers"
        self.fusion_status = f"{arena}/fusion/status"
        self.fusion_alive = f"{arena}/fusion/alive"  # liveliness token
        self.wand = f"{arena}/calib/wand"  # liveliness token of a program that records the wand

    def detections(self, camera: str = "*") -> str:
        return f"{self.arena}/camera/{camera}/detections"

    def relative(self, camera: str = "*") -> str:
        return f"{self.arena}/camera/{camera}/relative"

    def camera_in(self, key: str) -> str | None:
        """The camera of a key on which detections are published; None for other keys."""
        camera = key.removeprefix(f"{self.arena}/camera/").removesuffix("/detections")
        return camera if key == self.detections(camera) else None

    def camera_status(self, camera: str = "*") -> str:
        return f"{self.arena}/camera/{camera}/status"

    def camera_alive(self, camera: str = "*") -> str:  # liveliness token
        return f"{self.arena}/camera/{camera}/alive"

    def preview(self, camera: str = "*") -> str:
        """Zenoh's wildcards do not include a part with @: a recorder of all keys asks no camera for pictures."""
        return f"{self.arena}/camera/{camera}/@preview"

    def snapshot(self, camera: str) -> str:
        return f"{self.arena}/camera/{camera}/snapshot"

    def settings(self, camera: str) -> str:
        return f"{self.arena}/camera/{camera}/settings"

    def robot_pose(self, robot: str = "*") -> str:
        return f"{self.arena}/robot/{robot}/pose"

    @property
    def poses(self) -> str:
        """All robots in one message. The part with @ is in no wildcard: a recorder of all keys gets each pose once."""
        return f"{self.arena}/@poses"


class MessageError(ValueError):
    """Invalid bytes in place of a message. Receivers count them and continue."""


class ColumnMessage(msgspec.Struct, frozen=True, kw_only=True):
    """A message with columns: arrays as little-endian bytes, one row for each roundel.

    Attributes:
        COLUMNS: type and number of values in each row; the first column gives the number of rows.
        MAX_ROWS: messages with more are refused.
        OPTIONAL: columns that are empty where no value is known.
    """

    COLUMNS: ClassVar[dict[str, tuple[np.dtype, int]]]
    MAX_ROWS: ClassVar[int]
    OPTIONAL: ClassVar[frozenset[str]] = frozenset()

    @classmethod
    def _to_bytes(cls, columns: Mapping[str, np.ndarray]) -> dict[str, bytes]:
        known = {
            name: column
            for name, column in columns.items()
            if name not in cls.OPTIONAL or not np.isnan(column).all()
        }
        return {name: column.astype(cls.COLUMNS[name][0]).tobytes() for name, column in known.items()}

    def __len__(self) -> int:
        name, (dtype, width) = next(iter(self.COLUMNS.items()))
        return len(getattr(self, name)) // (width * dtype.itemsize)

    def _column(self, name: str) -> np.ndarray:
        dtype, width = self.COLUMNS[name]
        column = np.frombuffer(getattr(self, name), dtype).astype(np.int32 if dtype is I4 else float)
        return column if width == 1 else column.reshape(-1, width)

    def _check_sizes(self) -> None:
        """Raise MessageError unless the sizes of the columns agree."""
        n = len(self)
        if n > self.MAX_ROWS:
            raise MessageError(f"{n} roundels; a message has at most {self.MAX_ROWS}")
        for name, (dtype, width) in self.COLUMNS.items():
            size = len(getattr(self, name))
            if size != n * width * dtype.itemsize and not (name in self.OPTIONAL and size == 0):
                raise MessageError(f"column {name} of {size} bytes for {n} roundels")


class Detections(ColumnMessage, frozen=True, kw_only=True):
    """All roundels of one frame. `t_ns` is the middle of the exposure in the server's time (Unix, nanoseconds).

    A rolling shutter exposes the rows one after another, during `readout_us`: `t_ns` is that of the middle of the
    image, and a row at height h (`Lens.image_row`) is captured h readout times later. Where the last row is read
    first, it is negative.

    Columns with one row for each roundel: `uv` (N, 2) <f8 raw pixels; `cov` (N, 3) <f4 uu, uv, vv, square pixels;
    `axes_px` (N, 2) <f4 full major and minor axis; `angle_rad`, `ratio`, `contrast` (N,) <f4;
    `id` and `track` (N,) <i4, -1 for none; `id_probability`, `rotation_rad` and `rotation_sigma` (N,) <f4 of a code
    (`Roundels`), left out where no roundel of the frame has one. Unknown values are NaN.
    """

    COLUMNS: ClassVar = {
        "uv": (F8, 2),
        "cov": (F4, 3),
        "axes_px": (F4, 2),
        "angle_rad": (F4, 1),
        "ratio": (F4, 1),
        "contrast": (F4, 1),
        "id": (I4, 1),
        "track": (I4, 1),
        "id_probability": (F4, 1),
        "rotation_rad": (F4, 1),
        "rotation_sigma": (F4, 1),
    }
    MAX_ROWS: ClassVar = MAX_ROUNDELS
    OPTIONAL: ClassVar = frozenset({"id_probability", "rotation_rad", "rotation_sigma"})

    version: int = VERSION
    camera: str
    seq: int
    publisher: int = 0  # random number of the node that runs, 0 if unknown: see `Publishers`
    t_ns: int
    exposure_us: float = 0.0
    readout_us: float = 0.0  # of all rows, see above; 0 of a global shutter or if unknown
    detect_us: float = 0.0  # duration of detection
    sent_ns: int = 0  # time of publication, server's time
    clock_error_us: float = 0.0  # bound of the clock error in `t_ns`; NaN before the server's first answer
    width: int
    height: int
    found_ratios: tuple[float, ...] = ()  # of the prints that recur, if the detector was given none
    uv: bytes
    cov: bytes
    axes_px: bytes
    angle_rad: bytes
    ratio: bytes
    contrast: bytes
    id: bytes
    track: bytes
    id_probability: bytes = b""
    rotation_rad: bytes = b""
    rotation_sigma: bytes = b""

    @classmethod
    def pack(cls, roundels: Roundels, **header) -> "Detections":
        """Build a message from `roundels`; `header` contains the fields that are not columns."""
        columns = {name: getattr(roundels, name) for name in cls.COLUMNS}
        columns["cov"] = roundels.cov.reshape(-1, 4)[:, [0, 1, 3]]
        return cls(**cls._to_bytes(columns), **header)

    def unpack(self) -> Roundels:
        """Convert the columns to arrays."""
        shape, code = (self.angle_rad, self.ratio, self.contrast), (self.id_probability, self.rotation_rad)
        numbers = _core.unpack_detections(self.uv, self.cov, self.axes_px, *shape, *code, self.rotation_sigma)
        n = len(numbers) // 14
        angle_rad, ratio, contrast, *of_code = numbers[8 * n :].reshape(6, n)
        return Roundels(
            numbers[: 2 * n].reshape(n, 2),
            numbers[2 * n : 6 * n].reshape(n, 2, 2),
            numbers[6 * n : 8 * n].reshape(n, 2),
            angle_rad,
            ratio,
            contrast,
            np.frombuffer(self.id, I4),
            np.frombuffer(self.track, I4),
            *of_code,
        )

    def check(self) -> None:
        """Raise MessageError unless sizes agree, centres are finite and covariances positive definite and small."""
        self._check_header()
        shape = self.uv, self.cov, self.axes_px, self.angle_rad, self.ratio, self.contrast
        codes = self.id, self.track, self.id_probability, self.rotation_rad, self.rotation_sigma
        if fault := _core.fault_of_detections(self.MAX_ROWS, MAX_VARIANCE_PX2, *shape, *codes):
            self._check_sizes()  # says which column
            raise MessageError(fault)

    def _check_header(self) -> None:
        if not (is_name(self.camera) and 0 < self.width <= 32768 and 0 < self.height <= 32768):
            raise MessageError("an invalid camera name, or an impossible image size")
        if not (0 <= self.t_ns < 2**63 and math.isfinite(self.exposure_us) and math.isfinite(self.detect_us)):
            raise MessageError("an impossible t_ns, exposure_us or detect_us")
        if not abs(self.readout_us) <= MAX_READOUT_US:
            raise MessageError("an impossible readout_us")
        if self.clock_error_us < 0 or math.isinf(self.clock_error_us):
            raise MessageError("an impossible clock_error_us")
        if not 0 <= self.publisher < 2**63:
            raise MessageError("an impossible publisher")
        _check_ratios(self.found_ratios)


def _check_ratios(ratios: tuple[float, ...]) -> None:
    if len(ratios) > MAX_RATIOS or not all(0 < ratio < 1 for ratio in ratios):
        raise MessageError("found_ratios are too many or not in (0, 1)")


class RelativePositions(ColumnMessage, frozen=True, kw_only=True):
    """The roundels of one frame relative to the camera, which locates them by itself.

    `camera`, `seq` and the times are those of its `Detections`. Columns with one row for each roundel, as in
    `LocatedRoundels`: `position` (N, 3) <f8; `cov` (N, 6) <f8 xx, xy, xz, yy, yz, zz; `normals` (N, 2, 3) <f4;
    `probability` (N,) <f4 of the first normal; `normal_sigma` (N, 2) <f4; `axis_distance` (N,) <f4; `id` and `track`
    (N,) <i4, -1 for none.
    """

    COLUMNS: ClassVar = {
        "position": (F8, 3),
        "cov": (F8, 6),
        "normals": (F4, 6),
        "probability": (F4, 1),
        "normal_sigma": (F4, 2),
        "axis_distance": (F4, 1),
        "id": (I4, 1),
        "track": (I4, 1),
    }
    MAX_ROWS: ClassVar = MAX_POSITIONS

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
        columns = {name: getattr(located, name) for name in cls.COLUMNS}
        columns["cov"] = located.cov[:, *UPPER]
        columns["probability"] = located.probability[:, 0]
        return cls(**cls._to_bytes(columns), **header)

    @np.errstate(invalid="ignore")  # the conversion turns signalling NaNs into quiet ones
    def unpack(self) -> LocatedRoundels:
        """Convert the columns to arrays."""
        columns = {name: self._column(name) for name in self.COLUMNS}
        columns["cov"] = self._covariances()
        columns["normals"] = columns["normals"].reshape(-1, 2, 3)
        first = columns["probability"]
        columns["probability"] = np.stack([first, 1 - first], axis=1)
        return LocatedRoundels(**columns)

    def _covariances(self) -> Array:
        values = self._column("cov")
        cov = np.empty((len(values), 3, 3))
        cov[:, UPPER[0], UPPER[1]] = cov[:, UPPER[1], UPPER[0]] = values
        return cov

    @np.errstate(invalid="ignore", over="ignore")  # as in `unpack`
    def check(self) -> None:
        """Raise MessageError unless sizes agree, and positions, covariances, normals and probabilities are possible."""
        self._check_sizes()
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


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height that a JPEG declares; None for anything else.

    It is not decoded: a few kilobytes can declare an image of many gigabytes.
    """
    if not data.startswith(JPEG_START):
        return None
    at = len(JPEG_START)
    while at + JPEG_SIZE_BYTES <= len(data) and data[at] == 0xFF:
        if data[at + 1] in JPEG_SIZE_MARKERS:
            height, width = (int.from_bytes(data[at + k : at + k + 2], "big") for k in (5, 7))
            return (width, height) if width and height else None
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return None


class Preview(msgspec.Struct, frozen=True, kw_only=True):
    """A small picture of a camera with the detected roundels drawn, published while anyone subscribes."""

    version: int = VERSION
    camera: str
    t_ns: int  # time of publication, server's time
    width: int  # of the camera's image, pixels; the picture is smaller
    height: int
    jpeg: bytes

    def check(self) -> None:
        """Raise MessageError unless the picture is a JPEG of bounded size."""
        size = jpeg_size(self.jpeg)
        if size is None or len(self.jpeg) > MAX_PREVIEW_BYTES or max(size) > MAX_PREVIEW_SIDE:
            raise MessageError(f"a picture of {len(self.jpeg)} bytes and size {size}, which is no small JPEG")


class CameraStatus(msgspec.Struct, frozen=True, kw_only=True):
    """Condition of a camera, published once per second."""

    version: int = VERSION
    camera: str
    t_ns: int
    width: int
    height: int
    fps: float
    frames: int  # since the node started
    dropped: int  # frames skipped since the start because a newer one was available
    incomplete: int = 0  # frames since the start that were discarded because parts of them did not arrive
    lost_packets: int = 0  # packets of the camera's network connection since the start that never arrived
    detect_ms: float  # mean over the last second
    roundels: float  # mean number in each frame over the last second
    saturated: float  # share of pixels at the upper end of the grey levels, 0 to 1
    threshold: float | None = None  # theta of `--detector paper`, grey levels; None with other detectors
    found_ratios: tuple[float, ...] = ()  # of the prints that recur, if the detector was given none
    tone_exponent: float | None = (
        None  # of the camera's tone curve; 1 if linear, None before roundels show it
    )
    exposure_us: float | None = None
    gain: float | None = None
    # The server's time minus this machine's, and a bound of its error; None until a round trip succeeds.
    clock_offset_ms: float | None = None
    clock_error_ms: float | None = None
    temperature_c: float | None = None
    edge_blur_px: float | None = (
        None  # standard deviation of the blur of the roundels' edges; None without roundels
    )
    advice: str = ""  # "saturated", "too dark" or "out of focus" with the change to make, or empty
    # Refused requests for a snapshot or settings, and undecodable rigs, since the node started.
    refused: int = 0

    def check(self) -> None:
        """Raise MessageError for a name that no camera can have, or impossible ratios."""
        if not is_name(self.camera):
            raise MessageError("an invalid camera name")
        _check_ratios(self.found_ratios)


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings that can be changed while a camera runs.

    None leaves a setting unchanged in a request, and means unknown or unset in a reply. `exposure_us`, `gain` and
    `controls` belong to the camera, `readout_us` says how its shutter works (`Detections`), the rest belongs to
    `Detector`. `controls` maps names of the driver's controls to values; those that it does not name are unchanged.
    `mask` lists polygons of three or more [u, v], raw pixels, in which roundels are ignored.
    """

    version: int = VERSION
    exposure_us: float | None = None
    gain: float | None = None
    controls: dict[str, ControlValue] | None = None
    readout_us: float | None = None
    mask: tuple[tuple[tuple[float, float], ...], ...] | None = None
    inner_ratios: tuple[float, ...] | None = None
    ratio_tolerance: float | None = None
    min_contrast: float | None = None
    min_diameter_px: float | None = None
    max_diameter_px: float | None = None
    search_share: float | None = None

    def check(self) -> None:
        """Raise MessageError where no camera can have these settings."""
        if not all(x is None or math.isfinite(x) for x in (self.exposure_us, self.gain)):
            raise MessageError("exposure and gain must be finite")
        if self.readout_us is not None and not abs(self.readout_us) <= MAX_READOUT_US:
            raise MessageError(f"readout_us is {self.readout_us}; give a number within {MAX_READOUT_US:g}")
        if self.exposure_us is not None and not 0 < self.exposure_us <= 1e7:
            raise MessageError(f"exposure_us is {self.exposure_us}; give a number in (0, 1e7]")
        _check_controls(self.controls or {})


def _check_controls(controls: dict[str, ControlValue]) -> None:
    texts = [*controls, *(value for value in controls.values() if isinstance(value, str))]
    if len(controls) > MAX_CONTROLS or any(len(text) > MAX_CONTROL for text in texts):
        raise MessageError(f"more than {MAX_CONTROLS} controls, or a name or text of more than {MAX_CONTROL}")
    numbers = [value for value in controls.values() if not isinstance(value, str)]
    if not all(math.isfinite(value) and abs(value) < 2**63 for value in numbers):
        raise MessageError("values of controls must be finite and below 2^63")


class ClockReply(msgspec.Struct, frozen=True):
    """The server's time, in answer to a query on `<arena>/clock`, and the name of its clock."""

    t_ns: int
    clock: str = ""  # empty where the server can't name it
    monotonic_ahead_ns: int | None = None  # t_ns minus the monotonic clock of the server's machine


def encode(message: msgspec.Struct) -> bytes:
    """Encode a message as MessagePack."""
    return msgspec.msgpack.encode(message)


_decoders: dict[type, msgspec.msgpack.Decoder[Any]] = {}
_building = threading.Lock()


def _decoder(kind: type[T]) -> "msgspec.msgpack.Decoder[T]":
    """The decoder of a kind. One thread builds it: two that do so at once for types with a common part read memory that
    is not written yet, and the process ends (msgspec 0.22, `test_threads_that_decode_a_kind_first_do_not_crash`)."""
    if kind not in _decoders:
        with _building:
            _decoders.setdefault(kind, msgspec.msgpack.Decoder(kind))
    return _decoders[kind]


def decode(data: bytes, kind: type[T]) -> T:
    """Decode and check bytes from the network.

    Raises:
        MessageError: the bytes are not a message of this kind and version, or a value is invalid.
    """
    if len(data) > (limit := getattr(kind, "MAX_BYTES", MAX_BYTES)):
        raise MessageError(f"{kind.__name__} of {len(data)} bytes; the limit is {limit}")
    try:
        message = _decoder(kind).decode(data)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(str(error)) from None
    if getattr(message, "version", VERSION) != VERSION:
        raise MessageError(f"version {getattr(message, 'version', None)}; this program supports {VERSION}")
    check = getattr(message, "check", None)
    if check:
        check()
    return message
