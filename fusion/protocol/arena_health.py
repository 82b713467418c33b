# SPDX-License-Identifier: BSD-3-Clause
"""What an arena's status means for an operator: one line, and what needs attention."""

from datetime import UTC, datetime
from typing import Any

import msgspec

from calib.rig.rig import Rig
from camera_node.protocol.presence import MAX_NAMED, NO_CAMERA, listed, no_such
from fusion.protocol.pose_messages import SKIPPED_S, CameraHealth, Contradiction, FusionStatus

MAX_CALIBRATION_DAYS = 90
POOR_GRADES = "CD"
# Of frames, that may be lost: single frames are lost in any wireless network, and a robot coasts longer than their gap.
SKIPPED_SHARE = 0.05
NOT_FOUND = "not found"  # the state of a declared robot that was never tracked


class Calibration(msgspec.Struct, frozen=True, kw_only=True):
    """The state of the calibration in force; None where it does not say."""

    placed: int  # cameras with a pose
    grade: str | None = None
    age_days: float | None = None


class ArenaHealth(msgspec.Struct, frozen=True, kw_only=True):
    """The state of an arena. `problems` has one line for each thing that needs attention; without any it is healthy."""

    cameras: dict[str, bool]  # whether each sends frames
    robots: dict[str, str]  # the state of each
    poses_per_s: float
    faults: int  # skipped messages and frame sets since the server's start
    calibration: Calibration
    problems: tuple[str, ...]

    @property
    def line(self) -> str:
        """Cameras, robots, faults and calibration in one line, and the first problem."""
        tracked = sum(state == "tracked" for state in self.robots.values())
        parts = [
            f"{sum(self.cameras.values())} of {len(self.cameras)} cameras",
            f"{tracked} of {len(self.robots)} robots tracked",
            f"{self.poses_per_s:.0f} frame sets/s",
            f"{self.faults} faults since the start",
            describe_calibration(self.calibration),
        ]
        for problem in self.problems:
            more = f" (and {len(self.problems) - 1} more)" if len(self.problems) > 1 else ""
            return f"attention: {problem}{more} | {', '.join(parts)}"
        return f"healthy: {', '.join(parts)}"


def assess_health(status: FusionStatus, rig: Rig | None, now: datetime) -> ArenaHealth:
    """The health of an arena by its server's status and the rig in force."""
    calibration = assess_calibration(rig, now)
    problems = [
        f"camera {name}: {p}" for name, health in status.cameras.items() for p in camera_problems(health)
    ]
    placed = rig.placed() if rig else {}
    problems += [f"camera {name}: never sent a frame" for name in placed if name not in status.cameras]
    problems += [f"robot {name} is {state}" for name, state in status.robots.items() if state != "tracked"]
    never = {name: cause for name, cause in status.not_acquired.items() if name not in status.robots}
    problems += [f"robot {name} was never found: {cause}" for name, cause in never.items()]
    problems += [
        f"robot {name}: its discs measure {1e3 * diameter_m:.0f} mm, not as declared"
        for name, diameter_m in status.measured_diameters_m.items()
    ]
    problems += [describe_contradiction(contradiction) for contradiction in status.contradictions]
    problems += calibration_problems(calibration)
    return ArenaHealth(
        cameras={name: False for name in placed} | {name: c.fps > 0 for name, c in status.cameras.items()},
        robots={**status.robots, **dict.fromkeys(never, NOT_FOUND)},
        poses_per_s=status.frame_sets_per_s,
        faults=sum(status.faults.values()),
        calibration=calibration,
        problems=tuple(problems),
    )


def camera_problems(health: CameraHealth) -> list[str]:
    """What needs attention at one camera."""
    states = {
        "sends no frames": health.fps == 0,
        "is not calibrated": not health.calibrated,
        "was moved and is excluded": health.excluded,
        "repeats an old image": health.frozen,
        "two nodes use its name": health.duplicate_publisher,
        f"its stamps are not known to better than {health.clock_sigma_ms:.0f} ms, because they may have jumped; robots "
        "in motion will show it": health.clock == "uncertain",
    }
    return [problem for problem, holds in states.items() if holds] + _skipped_frames(health)


def _skipped_frames(health: CameraHealth) -> list[str]:
    """The frames of a calibrated camera that were not used, where they are many."""
    tolerated = SKIPPED_SHARE * SKIPPED_S * health.fps
    if not health.calibrated or sum(health.skipped.values()) <= tolerated:
        return []
    reasons = ", ".join(f"{count} {reason}" for reason, count in sorted(health.skipped.items()))
    return [f"frames of the last {SKIPPED_S} s are not used: {reasons}"]


def describe_contradiction(contradiction: Contradiction) -> str:
    """Who contradicts the claims, by how much, and the likely causes."""
    times = f"{contradiction.error_over_claim:.1f} times their claim"
    size = f"by {contradiction.size_mm:.1f} mm (squared residuals {times})"
    names = listed(contradiction.names)
    if contradiction.kind == "camera":
        cause = "it was moved, or its lens or clock changed"
        return f"camera {names} contradicts the other cameras {size}: {cause}; calibrate it again"
    if contradiction.kind == "robot":
        return f"robot {names}: its markers are not where robots.yaml has them, {size}; measure it again"
    if contradiction.kind == "names":
        rounds = zip(contradiction.names, (*contradiction.names[1:], contradiction.names[0]), strict=True)
        shown = ", ".join(f"{name} shows what {other} should" for name, other in rounds)
        remedy = "they are not used until each node starts with its own name"
        return f"cameras {names} have exchanged names: {shown}; {remedy}"
    if contradiction.kind == "wand":
        return f"the rig and all robots differ in size {size}; measure the wand and the markers, and calibrate again"
    cause = "which one is wrong is undecided, or the lenses or the wand's lengths are"
    return f"cameras {names} contradict each other {size}: {cause}; calibrate again"


def assess_calibration(rig: Rig | None, now: datetime) -> Calibration:
    """The grade and the age that a rig states of itself."""
    if rig is None:
        return Calibration(placed=0)
    grade = rig.calibration.get("grade")
    return Calibration(
        placed=len(rig.placed()),
        grade=grade if isinstance(grade, str) and grade in "ABCD" else None,
        age_days=_age_days(rig.calibration.get("date"), now),
    )


def describe_calibration(calibration: Calibration) -> str:
    """Such as "calibration of grade B, 12 days old"."""
    if not calibration.placed:
        return "not calibrated"
    grade = f" of grade {calibration.grade}" if calibration.grade else ""
    days = calibration.age_days
    age = (
        "no date recorded" if days is None else f"{days:.0f} days old" if days >= 1 else "less than a day old"
    )
    return f"calibration{grade}, {age}"


def calibration_problems(calibration: Calibration) -> list[str]:
    """What needs attention at the calibration."""
    if not calibration.placed:
        return ["no camera has a pose; run roundel calibrate wand --live"]
    problems = []
    if calibration.grade and calibration.grade in POOR_GRADES:
        problems.append(f"the calibration has grade {calibration.grade}; repeat it as its report advises")
    if (calibration.age_days or 0.0) > MAX_CALIBRATION_DAYS:
        problems.append(f"the calibration is {calibration.age_days:.0f} days old; repeat it")
    return problems


def why_no_frames(status: FusionStatus) -> str:
    """Why no frames arrive at the server, and what to do; empty if some do."""
    if any(camera.fps > 0 for camera in status.cameras.values()):
        return ""
    if status.cameras:
        return f"no camera sends frames ({listed(status.cameras)}): check their programs and cables"
    return NO_CAMERA


def why_no_markers(status: FusionStatus) -> str:
    """Why the server locates nothing, and what to do; empty if it can."""
    sending = {name: camera for name, camera in status.cameras.items() if camera.fps > 0}
    if not any(camera.calibrated for camera in sending.values()):
        return why_no_frames(status) or (
            f"no camera that sends frames is calibrated ({listed(sending)}): run roundel calibrate wand --live"
        )
    return ""


def why_no_poses(status: FusionStatus, robot: str | None = None) -> str:
    """Why the server publishes no pose, of a robot or of any, and what to do; empty if it should."""
    declared = {*status.robots, *status.not_acquired}
    if robot is not None and declared and robot not in declared:
        return no_such("robot", robot, declared)
    if cause := why_no_markers(status):
        return cause
    if not declared:
        return "no robot is declared: use roundel define, or the tab Robots of the page"
    expected = sorted(declared) if robot is None else [robot]
    if any(status.robots.get(name) == "tracked" for name in expected):
        return ""
    reasons = (f"robot {name} is {_describe_robot(status, name)}" for name in expected[:MAX_NAMED])
    return f"the server runs and has frames, but {'; '.join(reasons)}"


def _describe_robot(status: FusionStatus, robot: str) -> str:
    state = status.robots.get(robot, "lost")
    reason = status.not_acquired.get(robot, "are its markers in view of the cameras?")
    return f"{'not found' if state == 'lost' else state}: {reason}"


def describe_status(status: FusionStatus) -> str:
    """The server's cameras, robots and rate in one line, for `systemctl status`."""
    live = sum(camera.fps > 0 for camera in status.cameras.values())
    tracked = sum(state == "tracked" for state in status.robots.values())
    declared = len({*status.robots, *status.not_acquired})
    return (
        f"{live} of {len(status.cameras)} cameras, {tracked} of {declared} robots tracked, "
        f"{status.frame_sets_per_s:.0f} frame sets/s, {sum(status.faults.values())} faults"
    )


def _age_days(date: Any, now: datetime) -> float | None:
    try:
        then = datetime.fromisoformat(str(date))
    except ValueError:
        return None
    return (now - then.replace(tzinfo=then.tzinfo or UTC)).total_seconds() / 86400
