# SPDX-License-Identifier: BSD-3-Clause
"""What a camera says over Zenoh: MessagePack maps, their arrays little-endian binary columns. Keys stand in `Keys`."""

import math
from typing import TypeVar

import msgspec
import numpy as np

from camera_node.detection.roundels import Roundels

VERSION = 1
MAX_ROUNDELS = 4096  # in one frame; a message that claims more is not one of ours
MAX_VARIANCE_PX2 = 1e4  # of a centre's coordinate: what is known no better tells nothing
T = TypeVar("T", bound=msgspec.Struct)


class Keys:
    """Zenoh keys of one arena (`docs/messages.md` lists who publishes what on them)."""

    def __init__(self, arena: str) -> None:
        self.arena = arena
        self.clock = f"{arena}/clock"  # queryable of the server: its time
        self.rig = f"{arena}/rig"
        self.markers = f"{arena}/markers"
        self.fusion_status = f"{arena}/fusion/status"
        self.fusion_alive = f"{arena}/fusion/alive"  # liveliness token

    def detections(self, camera: str = "*") -> str:
        return f"{self.arena}/camera/{camera}/detections"

    def camera_status(self, camera: str = "*") -> str:
        return f"{self.arena}/camera/{camera}/status"

    def camera_alive(self, camera: str = "*") -> str:  # liveliness token
        return f"{self.arena}/camera/{camera}/alive"

    def snapshot(self, camera: str) -> str:
        return f"{self.arena}/camera/{camera}/snapshot"

    def settings(self, camera: str) -> str:
        return f"{self.arena}/camera/{camera}/settings"

    def robot_pose(self, robot: str = "*") -> str:
        return f"{self.arena}/robot/{robot}/pose"


class MessageError(ValueError):
    """Bytes that are no message of ours. Whoever receives them counts them and goes on."""


class Detections(msgspec.Struct, frozen=True, kw_only=True):
    """All roundels of one frame. `t_ns` is the middle of the exposure in the server's time (Unix, nanoseconds).

    Columns, one row a roundel: `uv` (N, 2) <f8 raw pixels; `cov` (N, 3) <f4 uu, uv, vv, square pixels;
    `axes_px` (N, 2) <f4 full major and minor axis; `angle_rad`, `ratio`, `contrast` (N,) <f4;
    `id` and `track` (N,) <i4, -1 for none. A value that the sender does not know is NaN.
    """

    version: int = VERSION
    camera: str
    seq: int
    t_ns: int
    exposure_us: float = 0.0
    detect_us: float = 0.0  # from the frame in memory to the roundels
    sent_ns: int = 0  # when the message was handed to Zenoh, server's time
    clock_error_us: float = 0.0  # that clocks put `t_ns` off, at most; NaN before a server answered
    width: int
    height: int
    uv: bytes
    cov: bytes
    axes_px: bytes
    angle_rad: bytes
    ratio: bytes
    contrast: bytes
    id: bytes
    track: bytes

    @classmethod
    def pack(cls, roundels: Roundels, **header) -> "Detections":
        """A message of `roundels`; `header` holds the fields that are no columns."""
        cov = roundels.cov.reshape(-1, 4)[:, [0, 1, 3]]
        return cls(
            uv=roundels.uv.astype("<f8").tobytes(),
            cov=cov.astype("<f4").tobytes(),
            axes_px=roundels.axes_px.astype("<f4").tobytes(),
            angle_rad=roundels.angle_rad.astype("<f4").tobytes(),
            ratio=roundels.ratio.astype("<f4").tobytes(),
            contrast=roundels.contrast.astype("<f4").tobytes(),
            id=roundels.id.astype("<i4").tobytes(),
            track=roundels.track.astype("<i4").tobytes(),
            **header,
        )

    def __len__(self) -> int:
        return len(self.uv) // 16

    @np.errstate(invalid="ignore")  # a signalling NaN becomes a quiet one
    def unpack(self) -> Roundels:
        """The columns as arrays."""
        cov = _column(self.cov, "<f4", 3)[:, [0, 1, 1, 2]].reshape(-1, 2, 2)
        return Roundels(
            _column(self.uv, "<f8", 2),
            cov,
            _column(self.axes_px, "<f4", 2),
            *(_column(c, "<f4", 1)[:, 0] for c in (self.angle_rad, self.ratio, self.contrast)),
            *(np.frombuffer(c, "<i4").astype(np.int32) for c in (self.id, self.track)),
        )

    @np.errstate(invalid="ignore")  # likewise
    def check(self) -> None:
        """Raise MessageError unless sizes agree, centres are finite and covariances positive and small."""
        n, rest = divmod(len(self.uv), 16)
        if rest or n > MAX_ROUNDELS:
            raise MessageError(f"column uv of {len(self.uv)} bytes")
        sizes = {"cov": 12, "axes_px": 8, "angle_rad": 4, "ratio": 4, "contrast": 4, "id": 4, "track": 4}
        for name, size in sizes.items():
            if len(getattr(self, name)) != n * size:
                raise MessageError(f"column {name} of {len(getattr(self, name))} bytes for {n} roundels")
        if not (self.camera and 0 < self.width <= 32768 and 0 < self.height <= 32768):
            raise MessageError("no camera name, or an impossible image size")
        if not (0 <= self.t_ns < 2**63 and math.isfinite(self.exposure_us) and math.isfinite(self.detect_us)):
            raise MessageError("an impossible time")
        if self.clock_error_us < 0 or math.isinf(self.clock_error_us):
            raise MessageError("an impossible bound of a time")
        uu, uv, vv = _column(self.cov, "<f4", 3).T  # what is no number is in no range
        known = (uu > 0) & (uu < MAX_VARIANCE_PX2) & (vv < MAX_VARIANCE_PX2) & (uu * vv > uv * uv)
        if not (known.all() and (np.abs(np.frombuffer(self.uv, "<f8")) < 1e5).all()):
            raise MessageError("a centre or a covariance that is no number or out of range")


class CameraStatus(msgspec.Struct, frozen=True, kw_only=True):
    """How a camera does, once a second."""

    version: int = VERSION
    camera: str
    t_ns: int
    width: int
    height: int
    fps: float
    frames: int  # since the node started
    dropped: int  # frames that the source delivered late, or that were skipped to keep up
    detect_ms: float  # mean over the last second
    roundels: float  # mean number in a frame over the last second
    threshold: float  # grey level of the paper's theta; NaN where the detector has none
    saturated: float  # share of pixels at the upper end, 0 to 1
    exposure_us: float | None = None
    gain: float | None = None
    # The server's time less this machine's, and a bound of its error; None until a round trip succeeded.
    clock_offset_ms: float | None = None
    clock_error_ms: float | None = None
    temperature_c: float | None = None
    advice: str = ""  # "saturated" or "too dark" with what to change by how much, or nothing
    refused: int = 0  # requests for a snapshot or settings that were refused since the node started


class Settings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What can be changed while a camera runs. A field that is None is left as it is, or is not known to the camera.

    `mask` lists polygons of three or more [u, v], raw pixels, in which roundels are ignored; exposure and gain are a
    camera's, the others `Detector`'s settings of these names.
    """

    version: int = VERSION
    exposure_us: float | None = None
    gain: float | None = None
    mask: tuple[tuple[tuple[float, float], ...], ...] | None = None
    inner_ratios: tuple[float, ...] | None = None
    ratio_tolerance: float | None = None
    min_contrast: float | None = None
    min_diameter_px: float | None = None
    max_diameter_px: float | None = None
    search_share: float | None = None

    def check(self) -> None:
        """Raises MessageError where no camera can be set so."""
        if not all(x is None or math.isfinite(x) for x in (self.exposure_us, self.gain)):
            raise MessageError("exposure and gain must be finite")
        if self.exposure_us is not None and not 0 < self.exposure_us <= 1e7:
            raise MessageError(f"an exposure of {self.exposure_us} us is not possible")


class ClockReply(msgspec.Struct, frozen=True):
    """The server's time, in answer to a query on `<arena>/clock`, and its clock's name: who shares it is done."""

    t_ns: int
    clock: str = ""  # empty where the server can't tell


def encode(message: msgspec.Struct) -> bytes:
    """The message as MessagePack."""
    return msgspec.msgpack.encode(message)


def decode(data: bytes, kind: type[T]) -> T:
    """Decode and check bytes from the network.

    Raises:
        MessageError: they are no message of this kind and version, or its content is impossible.
    """
    try:
        message = msgspec.msgpack.decode(data, type=kind)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as error:
        raise MessageError(str(error)) from None
    if getattr(message, "version", VERSION) != VERSION:
        raise MessageError(f"version {getattr(message, 'version', None)}, this program speaks {VERSION}")
    check = getattr(message, "check", None)
    if check:
        check()
    return message


def _column(data: bytes, dtype: str, width: int) -> np.ndarray:
    return np.frombuffer(data, dtype).reshape(-1, width).astype(float)
