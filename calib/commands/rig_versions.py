# SPDX-License-Identifier: BSD-3-Clause
"""`roundel calibrate undo`, `redo` and `apply`: restore the previous rig, or the one that was undone last; have the
server use a rig."""

from dataclasses import dataclass
from pathlib import Path

from calib.commands.output import conclude, put_in_force
from calib.rig.file_history import History, Step
from calib.rig.rig import load_rig
from camera_node.foundation.errors import ConfigError
from camera_node.foundation.terminal import say
from camera_node.protocol.server_connection import LOCAL_SERVER, ConnectionOptions


@dataclass(frozen=True, kw_only=True)
class RestoreOptions:
    """The file to restore, and the server."""

    rig: Path
    """The rig to restore. Beside it are earlier rigs, rig.1.yaml, rig.2.yaml, ..., and undone ones, rig.undone.1.yaml,
    ..., newest last."""
    live: bool = False
    """Have the running server use the restored rig too."""
    connection: ConnectionOptions = LOCAL_SERVER

    def history(self) -> History:
        """Its versions; raises ConfigError if neither the file nor an earlier version exists."""
        if not self.rig.exists() and not (self.rig.parent.is_dir() and History(self.rig).older()):
            raise ConfigError(f"{self.rig} does not exist; check --rig")
        return History(self.rig)

    def take(self, direction: Step) -> None:
        """Swap the files, print what was restored, and hand it to the server."""
        history = self.history()
        rig = load_rig(history.neighbour(direction))  # a broken one is not restored
        step = history.take(direction)
        date = rig.calibration.get("date")
        made = f"made at {date}" if date else "no date recorded"
        replaced = f"; the rig that it replaces is saved as {step.replaced.name}" if step.replaced else ""
        say(f"restored {self.rig} from {step.restored.name} ({made}){replaced}")
        conclude(self.connection, rig, self.rig, f"roundel calibrate {direction}", live=self.live)


@dataclass(frozen=True, kw_only=True)
class Undo(RestoreOptions):
    """Restore the rig from before the last calibration; roundel calibrate redo reverts that."""

    def run(self) -> None:
        """See `RestoreOptions.take`."""
        self.take("undo")


@dataclass(frozen=True, kw_only=True)
class Redo(RestoreOptions):
    """Restore the rig that was undone last."""

    def run(self) -> None:
        """See `RestoreOptions.take`."""
        self.take("redo")


@dataclass(frozen=True, kw_only=True)
class Apply:
    """Have the running server use a rig, at once and after a restart."""

    rig: Path
    """The rig, such as one that roundel calibrate wand wrote without --live."""
    connection: ConnectionOptions = LOCAL_SERVER

    def run(self) -> None:
        """Hand the rig to the server."""
        put_in_force(self.connection, load_rig(self.rig), self.rig, "roundel calibrate apply")
