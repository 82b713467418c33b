# SPDX-License-Identifier: BSD-3-Clause
"""Fixes the floor, the origin and the axes from the page; `roundel calibrate world` does so in a terminal."""

from datetime import UTC, datetime
from pathlib import Path

import msgspec
import viser

from calib.live.collect import collect_frames
from calib.rig.camera import span_dimension
from calib.rig.rig import Rig
from calib.world.landmarks import FRAME, WAND, WorldChange, align_to_roundels, name_markers
from camera_node.foundation.config import example_file, load_yaml
from camera_node.geometry.body import Body
from web.condition import next_step
from web.errors import WebError
from web.own_control import OwnControl
from web.scene.surroundings import WorldPreview
from web.state.feed import ArenaState
from web.state.subscription import Subscription
from web.tabs.calibration_panels import CalibrationFiles, apply_rig, current_rig
from web.widgets import ActionButton, Answer, Decision

COLLECT_S = 3.0
STANDING, L_FRAME = "wand, upright at the origin", "L-frame, flat on the floor"
L_FILE = "l.yaml"  # beside the wand's file; the example of the package unless it exists
CHANGED = "the calibration was changed since, by another page or program: measure again"
MEASURE_HINT = "detects the roundels for 3 s; nothing moves until you accept"


class WorldPanel:
    """The folder "Floor and origin": measures the new world, shows it in the scene, and has the server use it."""

    def __init__(
        self,
        server: viser.ViserServer,
        subscription: Subscription,
        files: CalibrationFiles,
        collect_s: float = COLLECT_S,
    ) -> None:
        self._subscription, self._files, self._collect_s = subscription, files, collect_s
        self._before: Rig | None = None  # in which the new world was measured
        gui = server.gui
        place = gui.add_folder("Floor and origin", expand_by_default=False)
        with place:
            self._by = OwnControl(server, place, lambda gui: gui.add_dropdown("By", (STANDING, L_FRAME)))
            self._foot = OwnControl(server, place, _add_foot)
            self._answer = answer = Answer(gui)
            self._measure = ActionButton(gui, "Measure", self.measure, answer, MEASURE_HINT)
            self.decision = Decision(gui, "the new world", self._use, self._forget, answer)
        self._preview = WorldPreview(server.scene)

    def update(self, state: ArenaState) -> None:
        """Enable the buttons that can act; a rig that changed since the measurement voids it."""
        is_ready = self.decision.result is not None
        if is_ready and state.rig is not None and state.rig is not self._before:
            self.decision.clear()
            self._answer.show(CHANGED, "warn")
        placed = state.rig is not None and bool(state.rig.placed())
        is_next = next_step(state) == "floor" and not is_ready
        self._measure.show(enabled=placed and bool(state.cameras), primary=is_next)
        self.decision.show()

    def measure(self) -> str:
        """Measure the new world, and show its axes and floor in the present one.

        Raises:
            CalibrationError: no camera sends, or the roundels do not fix a world.
            ConfigError: the file of the wand or of the L-frame is invalid.
        """
        rig = current_rig(self._subscription, self._files)
        rig.require_placed(self._files.rig)
        body = load_yaml(self._body_file(), Body)
        standing = self._by.here.value == STANDING
        if standing and span_dimension(body.points) != 1:
            raise WebError(
                f"{self._files.wand} is not a straight wand with two or more roundels: use an L-frame"
            )
        session, arena = self._subscription.session, self._subscription.feed.keys.arena
        collected, _ = collect_frames(session, arena, self._collect_s, lambda *_: "")
        foot_m = float(self._foot.here.value) if standing else None
        change = align_to_roundels(
            rig, name_markers(body), collected.messages, foot_m, WAND if standing else FRAME
        )
        self._before, self.decision.result = rig, change
        self._preview.draw(change.origin_in(rig))
        missed = f"; not used: roundel {', '.join(change.missing)}" if change.missing else ""
        worst = 1e3 * max(change.distances.values(), default=0.0)
        fit = f"; roundels within {worst:.1f} mm of their places" if change.distances else ""
        return f"the new axes and floor are in the scene{fit}{missed}: accept or discard them"

    def _use(self, change: WorldChange) -> str:
        """Write the moved rig, and have the server use it; raises as `apply_rig`."""
        now = datetime.now(UTC).isoformat(timespec="seconds")
        misses = {name: round(1e3 * distance, 2) for name, distance in change.distances.items()}
        world = {"date": now, "command": "the page", "misses_mm": misses}
        rig = change.rig
        rig = msgspec.structs.replace(rig, calibration={**rig.calibration, "world": world})
        return f"the new world is {apply_rig(self._subscription, self._files, rig)}"

    def _forget(self) -> str:
        self._before = None
        self._preview.draw(None)
        return ""

    def _body_file(self) -> Path:
        if self._by.here.value == STANDING:
            return self._files.wand
        own = self._files.wand.with_name(L_FILE)
        return own if own.exists() else example_file(L_FILE)


def _add_foot(gui: viser.GuiApi) -> viser.GuiNumberHandle[float]:
    hint = "of the standing wand: height of its centre above the floor"
    return gui.add_number("Lowest roundel, m", 0.0, min=-1.0, max=5.0, step=0.001, hint=hint)
