# SPDX-License-Identifier: BSD-3-Clause
"""Bytes in place of a `RigMessage` or a `RigRequest` that a program must refuse."""

from typing import Any

import msgspec

from calib.rig.rig import Rig
from calib.rig.rig_messages import MAX_RIG_BYTES

NAN, HUGE = float("nan"), 1e308


def hostile_messages(rig: Rig) -> dict[str, bytes]:
    """Each has one fault in a valid message of `rig`, by the name of the fault."""
    faults = {fault: _pack(rig, **fields) for fault, fields in _camera_faults().items()}
    figures: dict[str, Any] = {
        "deep figures": _nested(20),
        "very deep figures": _nested(500),
        "many figures": list(range(60_000)),
        "a long text": "x" * 20_000,
        "binary figures": b"\0\1",
        "an extension": msgspec.msgpack.Ext(5, b"x"),
    }
    faults |= {fault: _pack(rig, figures={"x": value}) for fault, value in figures.items()}
    cameras = msgspec.to_builtins(rig)["cameras"]
    camera = next(iter(cameras.values()))
    return faults | {
        "10,000 cameras": _message({"cameras": {f"c{k}": camera for k in range(10_000)}}),
        "257 cameras": _message({"cameras": {f"c{k}": camera for k in range(257)}}),
        "too many pixels": _message(
            {"cameras": {f"c{k}": camera | {"width": 8000, "height": 8000} for k in range(20)}}
        ),
        "a name with a slash": _message({"cameras": {"a/b": camera}}),
        "a name with a line break": _message({"cameras": {"a\n\x1b[31m": camera}}),
        "an unknown field": _message({"cameras": cameras, "colour": 1}),
        "the rig as YAML": _message("cameras: {}"),
        "no rig": msgspec.msgpack.encode({"version": 1, "t_ns": 0}),
        "an array": msgspec.msgpack.encode([1, 2]),
        "half a message": _message({"cameras": cameras})[:100],
        "50,000 brackets": b"[" * 50_000,
        "nested arrays": b"\x91" * 200_000,
        "an array of 4 billion": b"\xdd\xff\xff\xff\xff",
        "too many bytes": _message({"cameras": cameras, "calibration": {"x": "y" * MAX_RIG_BYTES}}),
        "nothing": b"",
    }


def _camera_faults() -> dict[str, dict[str, Any]]:
    """Fields of one camera, by fault."""
    pose = {"position_m": (0.0, 0.0, 1.0), "wxyz": (1.0, 0.0, 0.0, 0.0)}
    return {
        "an offset of NaN": {"time_offset_ms": NAN},
        "an infinite offset": {"time_offset_ms": float("inf")},
        "an offset of 1e308": {"time_offset_ms": HUGE},
        "an offset of a year": {"time_offset_ms": 3e10},
        "a drift of 1": {"time_drift_ppm": 1e6},
        "a reference before 1970": {"time_reference_ns": -1},
        "a focal length of 0": {"fx": 0.0},
        "a focal length of NaN": {"fy": NAN},
        "a focal length of 1e308": {"fx": HUGE},
        "a principal point of 1e300": {"cx": 1e300},
        "an image of 2^40 px": {"width": 2**20, "height": 2**20},
        "an image of 1e9 px": {"width": 32768, "height": 32768},
        "a negative image": {"width": -640},
        "three distortion numbers": {"distortion": (0.1, 0.1, 0.1)},
        "1e5 distortion numbers": {"distortion": (0.1,) * 100_000},
        "a distortion of 1e300": {"distortion": (1e300, 0.0, 0.0, 0.0)},
        "a position of NaN": {"T_world_cam": {**pose, "position_m": (NAN, 0.0, 0.0)}},
        "a position of 1e300": {"T_world_cam": {**pose, "position_m": (1e300, 0.0, 0.0)}},
        "a zero quaternion": {"T_world_cam": {**pose, "wxyz": (0.0, 0.0, 0.0, 0.0)}},
        "a quaternion of 1e308": {"T_world_cam": {**pose, "wxyz": (HUGE, HUGE, 0.0, 0.0)}},
        "a quaternion of two numbers": {"T_world_cam": {**pose, "wxyz": (1.0, 0.0)}},
        "a covariance of 2 x 2": {"covariance": ((1.0, 0.0), (0.0, 1.0))},
        "a covariance of NaN": {"covariance": ((NAN,) * 6,) * 6},
        "a negative variance": {"covariance": ((-1.0,) * 6,) * 6},
        "a text for a number": {"fx": "800"},
        "an unknown lens": {"model": "mirror"},
    }


def _pack(rig: Rig, figures: dict[str, Any] | None = None, **fields: Any) -> bytes:
    cameras = msgspec.to_builtins(rig)["cameras"]
    first = next(iter(cameras))
    changed = {**cameras, first: {**cameras[first], **fields}}
    return _message({"cameras": changed, "calibration": figures or {}})


def _message(rig: Any) -> bytes:
    return msgspec.msgpack.encode({"version": 1, "rig": rig})


def _nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = [value]
    return value


def as_publication(request: bytes) -> bytes:
    """The same fault in a `RigMessage`: a request has no `t_ns`."""
    try:
        fields = msgspec.msgpack.decode(request)
    except (msgspec.DecodeError, RecursionError):
        return request
    return msgspec.msgpack.encode({**fields, "t_ns": 0}) if isinstance(fields, dict) else request
