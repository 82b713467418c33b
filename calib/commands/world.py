# SPDX-License-Identifier: BSD-3-Clause
"""`calib world`: ground plane, origin and axes."""

from dataclasses import dataclass
from pathlib import Path

from rich.console import Console

from calib.commands.output import check_folder, say, write_rig
from calib.rig import load_rig
from calib.world import align, read_positions


@dataclass(frozen=True, kw_only=True)
class World:
    """Move the world so that cameras stand where they were surveyed."""

    rig: Path
    """A rig with poses."""
    positions: Path
    """CSV with camera,x,y,z: three or more cameras, metres."""
    out: Path
    """Where the moved rig is written."""

    def execute(self, console: Console) -> None:
        """Align to surveyed camera positions."""
        check_folder(self.out)
        rig = load_rig(self.rig)
        rig.require_placed(self.rig)
        moved, misses = align(rig, read_positions(self.positions))
        for name, miss in misses.items():
            say(console, f"{name}: {miss * 1e3:.1f} mm from its surveyed place")
        write_rig(moved, self.out, console)
