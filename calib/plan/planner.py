# SPDX-License-Identifier: BSD-3-Clause
"""Evaluates an arena, planned or calibrated: cameras per place, expected errors, blind spots, rate and network load.

The sensor model is that of Faigl, Krajnik, Chudoba and Saska (ICRA 2013), extended by `camera_node.sensor_model`. The
load follows from the size of the messages that cameras publish.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from calib.plan.camera_kind import CameraKind
from calib.plan.description import MAX_ROOM_M, Plan, PlannedRobots, Region, Volume, find_regions
from calib.plan.expected_error import (
    ExpectedErrors,
    RoundelSensor,
    Uncertainty,
    combine_views,
    expected_errors,
)
from calib.rig.camera import Camera
from camera_node.detection.roundels import Roundels
from camera_node.foundation.arrays import Array, Mask
from camera_node.protocol.messages import Detections, encode
from camera_node.sensor_model.operational_space import OperationalSpace, operational_space
from camera_node.sensor_model.threshold import threshold_D

PACKET_BYTES = 90  # Ethernet, IP and TCP headers and the frame of a Zenoh message, about
BUSY = 100e6  # bit/s: more needs a wired gigabit network
POINTS = 6000  # of the volume, about
DIAMETER_M = 0.09  # of the roundels that `roundel print` prints by default
LOW_M = 0.1  # height of the roundels of a ground robot
SMALL_REGION = 2e-3  # of the volume; smaller blind spots are not listed


@dataclass(frozen=True, slots=True)
class NetworkLoad:
    """What the cameras send to the server.

    Attributes:
        camera_bit_s: by camera, if robots are everywhere with the same probability, bit/s.
        total_bit_s: of all cameras.
        slowest_hz, fastest_hz: frame rates; poses are computed for each frame set, at about the fastest of them.
        detections_s: detections of all cameras in a second.
    """

    camera_bit_s: Mapping[str, float]
    total_bit_s: float
    slowest_hz: float
    fastest_hz: float
    detections_s: float


def network_load(robots: PlannedRobots, fps: Mapping[str, float], shares: Mapping[str, float]) -> NetworkLoad:
    """The load of cameras with frame rates `fps`, which see these `shares` of the volume, both by name."""
    n = robots.count * len(robots.markers)
    load = {name: 8 * rate * message_bytes(n * shares[name]) for name, rate in fps.items()}
    detections = sum(rate * n * shares[name] for name, rate in fps.items())
    rates = list(fps.values()) or [0.0]
    return NetworkLoad(load, sum(load.values()), min(rates), max(rates), detections)


def message_bytes(n: float) -> float:
    """Bytes of one message with n roundels on the network; linear in n, by the encoder of the camera node."""
    empty, ten = (_encoded_bytes(k) for k in (0, 10))
    return PACKET_BYTES + empty + (ten - empty) / 10 * n


@cache
def _encoded_bytes(n: int) -> int:
    roundels = Roundels.from_points(np.zeros((n, 2)), 0.1)
    stamp = 1_800_000_000_000_000_000
    message = Detections.pack(
        roundels, camera="camera-1", seq=10**6, t_ns=stamp, sent_ns=stamp, width=1920, height=1080
    )
    return len(encode(message))


@dataclass(frozen=True, slots=True)
class PlannedArena:
    """Cameras with their kinds, both by name, and the plan that they serve."""

    plan: Plan
    cameras: Mapping[str, Camera]
    kinds: Mapping[str, CameraKind]

    @classmethod
    def of(cls, plan: Plan) -> "PlannedArena":
        """The plan's own cameras."""
        return cls(plan, {name: entry.camera() for name, entry in plan.cameras.items()}, plan.cameras)

    @classmethod
    def of_rig(cls, cameras: Mapping[str, Camera], plan: Plan) -> "PlannedArena":
        """The calibrated cameras of a rig; its file has neither rates nor exposures, so defaults count."""
        kinds = {
            name: CameraKind(width=camera.width, height=camera.height, focal_px=camera.fx, lens=camera.model)
            for name, camera in cameras.items()
        }
        return cls(plan, cameras, kinds)

    @classmethod
    def of_cameras(cls, plan: Plan, cameras: Mapping[str, Camera], kind: CameraKind) -> "PlannedArena":
        """Cameras of one kind, such as a suggested placement."""
        return cls(plan, cameras, dict.fromkeys(cameras, kind))

    @property
    def uncertainty(self) -> Uncertainty:
        """What adds to the detector's noise."""
        return Uncertainty(self.plan.image.sigma_px, self.plan.robots.speed_m_s)

    def sensors(self) -> dict[str, RoundelSensor]:
        """How each camera sees roundels; cameras with the same exposure and shutter share one."""
        unique: dict[tuple[float, float], RoundelSensor] = {}
        sensors = {}
        for name, kind in self.kinds.items():
            key = (kind.exposure_s, kind.stamp_sigma_s)
            sensors[name] = unique.setdefault(key, RoundelSensor.of(self.plan, kind))
        return sensors

    def errors_at(self, points: Array) -> ExpectedErrors:
        """Expected errors of robots at points (N, 3), world, metres."""
        sums = combine_views(self.cameras, self.sensors(), points, self.uncertainty)
        return expected_errors(sums, self.plan.robots.points)


@dataclass(frozen=True, slots=True)
class CameraReach:
    """What one camera sees.

    Attributes:
        space: the operational space of level roundels, as slanted as on the optical axis; all 0 if that is too much.
        share: fraction of the volume in which it detects roundels.
    """

    space: OperationalSpace
    share: float


@dataclass(frozen=True, slots=True, eq=False)
class PlanReport:
    """The evaluation of an arena.

    Attributes:
        arena: what was evaluated.
        volume: the N points.
        errors: expected at these points.
        reach: of each camera, by name.
        blind: the regions that fewer than two cameras see, largest first.
        network: rate and load.
    """

    arena: PlannedArena
    volume: Volume
    errors: ExpectedErrors
    reach: Mapping[str, CameraReach]
    blind: tuple[Region, ...]
    network: NetworkLoad

    @property
    def covered(self) -> Mask:
        """(N,) whether two cameras or more see the point."""
        return self.errors.cameras >= 2

    @property
    def median_mm(self) -> float:
        """Median error where two cameras or more see; infinite if there is no such point."""
        return self.quantile_mm(0.5)

    def quantile_mm(self, q: float) -> float:
        """Quantile of the error where two cameras or more see; infinite if there is no such point."""
        known = self.errors.position_mm[self.covered]
        return float(np.quantile(known, q)) if known.size else float("inf")

    @property
    def median_deg(self) -> float:
        """Median error of the orientation where two cameras or more see; NaN for robots with one or two roundels."""
        known = self.errors.orientation_deg[self.covered]
        return float(np.median(known)) if known.size else float("nan")

    def share_within(self, error_mm: float) -> float:
        """Fraction of the volume with at most this error."""
        return float(np.mean(self.errors.position_mm <= error_mm))

    @property
    def is_sufficient(self) -> bool | None:
        """Whether the plan's requirement is met; None without one."""
        required = self.arena.plan.required
        return None if required is None else self.share_within(required.error_mm) >= required.share


def plan_around(cameras: Mapping[str, Camera], highest_m: float = LOW_M) -> Plan:
    """A plan for the space under the cameras of a rig, with robots that carry one printed roundel each.

    Args:
        cameras: with poses, at least one.
        highest_m: height up to which roundels are considered, at most four fifths of that of the cameras.
    """
    centres = np.array([camera.matrix()[:3, 3] for camera in cameras.values()])
    low, high = centres.min(axis=0), centres.max(axis=0)
    middle = (low + high) / 2
    half = np.maximum(high - low, 1.0) / 2
    (x0, y0), (x1, y1) = (middle - half)[:2].tolist(), (middle + half)[:2].tolist()
    ceiling = min(max(float(high[2]), 2 * LOW_M), MAX_ROOM_M)
    robots = PlannedRobots(
        diameter_m=DIAMETER_M, heights_m=(LOW_M, max(LOW_M, min(highest_m, 0.8 * ceiling)))
    )
    return Plan(area_m=(x0, y0, x1, y1), ceiling_m=ceiling, robots=robots)


def evaluate(arena: PlannedArena, points: int = POINTS) -> PlanReport:
    """Predict coverage and errors at about so many points of the arena's volume."""
    plan, volume = arena.plan, arena.plan.volume(points)
    sensors, at = arena.sensors(), volume.points
    errors = arena.errors_at(at)
    reach = {
        name: _reach(camera, sensors[name], len(sensors[name].view(camera, at).rows) / len(at))
        for name, camera in arena.cameras.items()
    }
    blind = tuple(r for r in find_regions(volume, errors.cameras < 2) if r.share >= SMALL_REGION)
    shares = {name: one.share for name, one in reach.items()}
    load = network_load(plan.robots, {name: kind.rate for name, kind in arena.kinds.items()}, shares)
    return PlanReport(arena, volume, errors, reach, blind, load)


def _reach(camera: Camera, sensor: RoundelSensor, share: float) -> CameraReach:
    """A level roundel on the optical axis is slanted by the axis's angle from the vertical."""
    slant = float(np.arccos(np.clip(-camera.matrix()[2, 2], 0, 1)))
    D = sensor.min_diameter_px or float(threshold_D(slant, sensor.imaging, sensor.found_share))
    if not np.isfinite(D):
        return CameraReach(OperationalSpace(0.0, 0.0, 0.0, 0.0), share)
    return CameraReach(operational_space(camera, sensor.pattern.d_o, D, slant, slant), share)
