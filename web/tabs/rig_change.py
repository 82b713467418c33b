# SPDX-License-Identifier: BSD-3-Clause
"""Changes of the rig that the page makes: written to the rig's file, and in force on the server."""

from dataclasses import dataclass
from pathlib import Path

from calib.intrinsics.nominal_lens import load_known_lenses
from calib.live.rig_requests import set_rig
from calib.rig.rig import Rig, save_rig
from calib.rig.rig_messages import holds_rig
from camera_node.foundation.config import load_yaml
from camera_node.foundation.errors import RoundelError
from camera_node.geometry.body import PrintedWand
from web.state.subscription import Subscription


@dataclass(frozen=True)
class CalibrationFiles:
    """The rig, whose intrinsics are read and whose extrinsics are written, and the wand."""

    rig: Path
    wand: Path

    @property
    def candidate(self) -> Path:
        """The rig that is calibrated but not accepted yet, beside the rig."""
        return self.rig.with_name(f"{self.rig.stem}.candidate.yaml")

    def check(self) -> None:
        """Raise ConfigError or CalibrationError if a file is missing or invalid."""
        load_known_lenses(self.rig)
        load_yaml(self.wand, PrintedWand)


def current_rig(subscription: Subscription, files: CalibrationFiles) -> Rig:
    """The rig in force on the server; without one that of the file, or a rig without cameras.

    Raises:
        CalibrationError, ConfigError: the file is invalid.
    """
    in_force = subscription.feed.state().rig
    return in_force if in_force is not None else load_known_lenses(files.rig)


def apply_rig(subscription: Subscription, files: CalibrationFiles, rig: Rig) -> str:
    """Have the server use a rig, and write it; returns the outcome as text.

    The server is asked first: it may save its rig in the same file, which then is one step of the history.

    Raises:
        CalibrationError, ConfigError: the file can't be written.
    """
    outcome = "in force on the server"
    try:
        set_rig(subscription.session, subscription.feed.keys.arena, rig, "web")
    except RoundelError as error:
        outcome = f"{files.rig} is written, but not in force: {error}"
    if not holds_rig(files.rig, rig):
        save_rig(rig, files.rig)
    return outcome
