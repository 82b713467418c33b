# SPDX-License-Identifier: BSD-3-Clause
"""`roundel plan`: coverage and expected precision of an arena, planned or calibrated, and where to mount cameras."""

import contextlib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import tyro

from calib.commands.output import check_folder
from calib.plan.camera_kind import CameraKind, PlannedCamera
from calib.plan.catalogue import CATALOGUE
from calib.plan.description import MAX_CAMERAS, Plan, Suggestion
from calib.plan.placement import PlacementProblem, SuggestedPlaces, suggest_placement
from calib.plan.plan_report import check_report, write_report
from calib.plan.plan_summary import describe, summarize
from calib.plan.planner import PlannedArena, evaluate, plan_around
from calib.rig.camera import Camera
from calib.rig.rig import load_rig
from camera_node.foundation.config import dump_yaml, example_file, load_yaml, write_atomically
from camera_node.foundation.errors import ConfigError, RoundelError
from camera_node.foundation.terminal import progress_bar, say


@dataclass(frozen=True, kw_only=True)
class PlanArena:
    """Predict what the cameras of an arena see and how precisely, and suggest where to mount them."""

    plan: Annotated[Path | None, tyro.conf.Positional] = None
    """The description, such as configs/plan.yaml; may be left out with --rig or --catalogue."""
    rig: Path | None = None
    """Evaluate the calibrated cameras of this rig instead of those of the plan."""
    suggest: int | None = None
    """Place so many cameras where the plan's `suggest` allows it."""
    out: Path | None = None
    """Write the plan with the suggested cameras to this file."""
    report: Path | None = None
    """Write a report with figures, .html or .pdf."""
    json: bool = False
    """Print the result as JSON."""
    catalogue: bool = False
    """List the cameras that a plan can name as `model`, and end."""

    def run(self) -> None:
        """Print the result; write the report and the suggested plan."""
        if self.catalogue:
            list_catalogue()
            return
        self._check_files()
        arena = self._arena()
        result = evaluate(arena)
        if self.json:
            print(msgspec.json.encode(summarize(result)).decode())
        else:
            for line in describe(result):
                say(line)
        if self.report is not None:
            write_report(result, self.report, f"Arena {self.plan.stem if self.plan else self.rig}")
            self._note(f"wrote {self.report}")

    def _arena(self) -> PlannedArena:
        """The cameras to evaluate: suggested, calibrated, or those of the plan."""
        rig = {} if self.rig is None else load_rig(self.rig).require_placed(self.rig)
        plan = self._plan_of_rig(rig) if self.plan is None else _load_plan(self.plan)
        if self.suggest is not None:
            return self._suggest(plan, self.suggest)
        if rig:
            return PlannedArena.of_rig(rig, plan)
        if not plan.cameras:
            raise ConfigError(f"{self.plan} names no cameras; add them, or let --suggest N place them")
        return PlannedArena.of(plan)

    def _plan_of_rig(self, rig: dict[str, Camera]) -> Plan:
        try:
            return plan_around(rig)
        except ValueError as error:
            raise ConfigError(f"{self.rig}: {error}; give a plan with its own area_m") from None

    def _suggest(self, plan: Plan, count: int) -> PlannedArena:
        kind = (plan.suggest or _suggestion_like(plan, self.plan)).camera
        with progress_bar(f"placing {count} cameras") as progress:
            placement = suggest_placement(PlacementProblem(plan, kind), count, progress)
        plan = msgspec.structs.replace(plan, cameras=planned_cameras(placement, kind))
        if not self.json:
            for name, camera in plan.cameras.items():
                say(f"{name}: at {_place(camera.position_m)}, directed at {_place(camera.look_at_m)}")
        if self.out is not None:
            write_atomically(self.out, dump_yaml(plan))
            self._note(f"wrote {self.out}")
        return PlannedArena.of(plan)

    def _check_files(self) -> None:
        """Raise ConfigError for options that contradict each other, and for files that can't be written."""
        if self.plan is None and self.rig is None:
            raise ConfigError(
                f"give a plan such as {example_file('plan.yaml')}, or --rig with a calibrated rig"
            )
        if self.rig is not None and self.suggest is not None:
            raise ConfigError("--suggest places new cameras, --rig evaluates mounted ones; give one of them")
        if self.suggest is not None and not 1 <= self.suggest <= MAX_CAMERAS:
            raise ConfigError(f"--suggest {self.suggest} is not possible; give 1 to {MAX_CAMERAS} cameras")
        if self.out is not None:
            if self.suggest is None:
                raise ConfigError("--out writes suggested cameras; give --suggest N too")
            check_folder(self.out)
        if self.report is not None:
            check_report(self.report)

    def _note(self, text: str) -> None:
        if not self.json:
            say(text)


def planned_cameras(placement: SuggestedPlaces, kind: CameraKind) -> dict[str, PlannedCamera]:
    """Suggested cameras as entries of a plan."""
    fields = msgspec.structs.asdict(kind)
    pairs = zip(placement.positions_m.tolist(), placement.aims_m.tolist(), strict=True)
    return {
        f"camera-{k}": PlannedCamera(**fields, position_m=_rounded(position), look_at_m=_rounded(aim))
        for k, (position, aim) in enumerate(pairs, 1)
    }


def _load_plan(path: Path) -> Plan:
    """Read a plan; the error of a rig in its place names the option for rigs."""
    try:
        return load_yaml(path, Plan)
    except ConfigError as error:
        if not _is_rig(path):
            raise
        raise ConfigError(
            f"{path} describes calibrated cameras (rig.yaml); give it as --rig {path}"
        ) from error


def _is_rig(path: Path) -> bool:
    with contextlib.suppress(RoundelError):
        return bool(load_rig(path).cameras)
    return False


def list_catalogue() -> None:
    """Print the catalogue."""
    for name, camera in CATALOGUE.items():
        kind = CameraKind(model=name)
        half = camera.width / 2 / kind.focal
        fov = 2 * np.degrees(np.arctan(half) if camera.model == "pinhole" else half)
        say(
            f"{name:11} {camera.width} x {camera.height} px, {camera.fps:g} Hz, {camera.shutter} shutter, "
            f"{camera.focal_mm:g} mm, {fov:.0f} degrees: {camera.what} ({camera.source})"
        )


def _suggestion_like(plan: Plan, path: Path | None) -> Suggestion:
    """The kind of the plan's first camera; raises ConfigError if there is none."""
    first = next(iter(plan.cameras.values()), None)
    if first is None:
        raise ConfigError(
            f"{path} has neither `suggest` nor cameras; add suggest: {{camera: {{model: ov9281}}}}"
        )
    fields = {name: getattr(first, name) for name in CameraKind.__struct_fields__}
    return Suggestion(camera=CameraKind(**fields))


def _rounded(values: list[float]) -> tuple[float, float, float]:
    x, y, z = (round(value, 3) for value in values)
    return x, y, z


def _place(values: tuple[float, float, float]) -> str:
    return ", ".join(f"{value:.2f}" for value in values) + " m"
