# SPDX-License-Identifier: BSD-3-Clause
"""Changes of a rig, and the messages about the rig on Zenoh with their keys.

A change says what differs from the rig before, when it was made and by whom. A saved rig has its change as a comment in
its first line, so that a numbered version takes it along. Messages are encoded as in `camera_node.protocol.messages`.
"""

import hashlib
from datetime import datetime
from pathlib import Path
from typing import Annotated, ClassVar, Literal, TypeVar

import msgspec
import numpy as np

from calib.rig.camera import Camera
from calib.rig.file_history import Step
from calib.rig.rig import Rig, dump_rig
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import printable
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import VERSION, MessageError
from camera_node.protocol.requests import RequestSource

MOVED_MM = 0.05  # a smaller motion of a camera is none
MAX_NAMED = 3  # cameras whose motion is named
MAX_CHANGE = 1000  # characters of the text of a change
MARK = "# changed: "
MAX_LINE = 4096  # bytes of a first line
Change = TypeVar("Change", bound="RigChange")
RIGID_M = 1e-4  # that a common motion of all cameras leaves, at most
MAX_VERSIONS = 64  # in one history
MAX_RIG_BYTES = 1 << 20  # of a message; 256 cameras with their reports take a quarter


class RigChange(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A change of the rig.

    Attributes:
        t_ns: when it was made.
        change: what differs from the rig before; empty where unknown.
        source: who asked for it; None for the server itself, and where unknown.
        is_correction: whether the server made it by itself, for a camera that was moved.
    """

    t_ns: Annotated[int, msgspec.Meta(ge=0, le=2**63 - 1)]
    change: Annotated[str, msgspec.Meta(max_length=MAX_CHANGE)] = ""
    source: RequestSource | None = None
    is_correction: bool = False

    def line(self) -> str:
        """The first line of the rig's file."""
        return f"{MARK}{msgspec.json.encode(self).decode()}\n"


def read_change(path: Path) -> RigChange:
    """The change that made a saved rig; of a file without it, the time of the last modification.

    Raises:
        OSError: the file can't be read.
    """
    return _read_first_line(path, RigChange) or RigChange(t_ns=path.stat().st_mtime_ns)


def _read_first_line(path: Path, kind: type[Change]) -> Change | None:
    """What the first line of a saved file says; None without such a line. Raises OSError."""
    with path.open("rb") as file:
        line = file.readline(MAX_LINE)
    mark = MARK.encode()
    try:
        return msgspec.json.decode(line[len(mark) :], type=kind) if line.startswith(mark) else None
    except (msgspec.MsgspecError, ValueError):  # edited by hand
        return None


class SavedChange(RigChange, frozen=True, kw_only=True, omit_defaults=True):
    """The first line of a file that a server saved.

    Attributes:
        given: the digest of the user's file in place of which it is used (`file_digest`).
    """

    given: str = ""


def file_digest(path: Path | None) -> str:
    """What distinguishes a file's content from others: the start of its SHA-256; empty of a file that can't be read."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:32] if path is not None else ""
    except OSError:
        return ""


def read_given(path: Path) -> str | None:
    """The digest in the first line of a file that a server saved; None if there is none, as of older versions."""
    try:
        saved = _read_first_line(path, SavedChange)
    except OSError:
        return None
    return (saved and saved.given) or None


def without_change(text: str) -> str:
    """The text of a saved file without the line that says what changed."""
    return text.partition("\n")[2] if text.startswith(MARK) else text


def holds_rig(path: Path, rig: Rig) -> bool:
    """Whether a file holds a rig as `save_rig` writes it, whatever its first line says of the change."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return False
    return without_change(text) == dump_rig(rig)


def describe_change(before: Rig | None, after: Rig) -> str:
    """What changed from one rig to the next: cameras that were placed, removed, renamed or moved, lenses and clocks."""
    new, old = after.placed(), before.placed() if before is not None else {}
    if before is None:
        return f"{len(new)} cameras placed"
    renamed = _renamed(before.cameras, after.cameras)
    both = sorted(after.cameras.keys() & before.cameras.keys())
    parts = [f"{was} renamed {name}" for name, was in renamed.items()]
    parts += _describe_motion(old, new)
    parts += _name_some("{} placed", sorted(new.keys() - old.keys() - renamed.keys()))
    parts += _name_some("{} not placed", sorted(old.keys() - new.keys() - set(renamed.values())))
    now, then = after.cameras, before.cameras
    parts += _name_some("lens of {}", [name for name in both if _lens(now[name]) != _lens(then[name])])
    offsets = [name for name in both if now[name].clock != then[name].clock]
    parts += _name_some("clock offset of {}", offsets)
    return ", ".join(parts) or "the same poses"


def _renamed(old: dict[str, Camera], new: dict[str, Camera]) -> dict[str, str]:
    """The old name of each camera that has another one."""
    gone, added = old.keys() - new.keys(), sorted(new.keys() - old.keys())
    return {name: was for name in added for was in sorted(gone) if new[name] == old[was]}


def _describe_motion(old: dict[str, Camera], new: dict[str, Camera]) -> list[str]:
    both = sorted(new.keys() & old.keys())
    moved = {name: mm for name in both if (mm := moved_mm(old[name], new[name])) > MOVED_MM}
    if len(moved) > 1 and _is_one_motion([old[name] for name in both], [new[name] for name in both]):
        return ["floor and origin"]
    most = sorted(moved, key=moved.__getitem__, reverse=True)
    parts = [f"{name} {moved[name]:.1f} mm" for name in most[:MAX_NAMED]]
    return parts + ([f"{len(moved) - MAX_NAMED} more"] if len(moved) > MAX_NAMED else [])


def moved_mm(old: Camera, new: Camera) -> float:
    """How far the position of a camera differs between two rigs."""
    return 1e3 * float(np.linalg.norm(new.matrix()[:3, 3] - old.matrix()[:3, 3]))


def _is_one_motion(old: list[Camera], new: list[Camera]) -> bool:
    """Whether one motion moves all old poses to the new ones."""
    motion: Array = new[0].matrix() @ np.linalg.inv(old[0].matrix())
    errors = [np.abs(motion @ a.matrix() - b.matrix()).max() for a, b in zip(old, new, strict=True)]
    return max(errors) < RIGID_M


def _name_some(text: str, names: list[str]) -> list[str]:
    """A text about some cameras; of many, with their number."""
    if not names:
        return []
    return [text.format(", ".join(names) if len(names) <= MAX_NAMED else f"{len(names)} cameras")]


def _lens(camera: Camera) -> tuple[object, ...]:
    return tuple(getattr(camera, name) for name in Lens.__struct_fields__)


class RigMessage(msgspec.Struct, frozen=True, kw_only=True):
    """The calibration in force on the server, since `t_ns` in the server's time."""

    MAX_BYTES: ClassVar[int] = MAX_RIG_BYTES
    version: int = VERSION
    t_ns: int
    rig: Rig
    saved: bool = False  # in a file of the server, which it uses after a restart
    source: RequestSource | None = None  # of the request that changed the rig; None for the server itself

    def check(self) -> None:
        """Raise MessageError for a time before 1970 or beyond 64 bits."""
        if not 0 <= self.t_ns < 2**63:
            raise MessageError("an impossible t_ns")


class RigRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Asks the server to use another rig."""

    MAX_BYTES: ClassVar[int] = MAX_RIG_BYTES
    version: int = VERSION
    rig: Rig
    source: RequestSource | None = None

    def check(self) -> None:
        """Raise MessageError for a rig without cameras."""
        if not self.rig.cameras:
            raise MessageError("the rig names no camera")


class RigStepRequest(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Asks the server to undo the last change of the rig, or to redo the change that was undone last.

    Attributes:
        rig_t_ns: `t_ns` of the `RigMessage` that the sender takes to be in force; the request is refused where another
            one is, as after the same request of another operator. None for any.
    """

    version: int = VERSION
    source: RequestSource | None = None
    rig_t_ns: int | None = None


class RigVersion(RigChange, frozen=True, kw_only=True, omit_defaults=False):
    """A version of the rig: the change that made it, and the server's file that holds it."""

    state: Literal["earlier", "in force", "undone"]
    file: Annotated[str, msgspec.Meta(max_length=255)] = ""  # empty if a restart loses it

    def describe(self) -> str:
        """What it changed, when, and who made it."""
        made = datetime.fromtimestamp(self.t_ns / 1e9).isoformat(" ", "seconds")
        return f"{self.change or 'unknown change'} ({made}, by {self.source or self.unnamed_maker})"

    @property
    def unnamed_maker(self) -> str:
        """Who made it, where `source` does not say so."""
        return "the server" if self.is_correction else "the server or a file"


class RigHistory(msgspec.Struct, frozen=True, kw_only=True):
    """The versions of the rig in their order, oldest first: the earlier ones, the one in force, the undone ones."""

    version: int = VERSION
    rig_t_ns: int | None = None  # `t_ns` of the `RigMessage` in force; None without a rig
    versions: Annotated[tuple[RigVersion, ...], msgspec.Meta(max_length=MAX_VERSIONS)] = ()

    def subject(self, step: Step) -> RigVersion | None:
        """The version whose change an undo reverts, the one in force, or that a redo restores; None for none."""
        by_state = {version.state: version for version in reversed(self.versions)}
        if step == "redo":
            return by_state.get("undone")
        return by_state.get("in force") if "earlier" in by_state else None

    def describe_step(self, step: Step) -> str:
        """What a step has done that the server took, as a sentence for a terminal or the page."""
        version = self.subject(step)
        what = printable(version.describe()) if version else "the last change"
        return f"{'undone' if step == 'undo' else 'redone'} on the server: {what}"


def set_rig_key(arena: str) -> str:
    """The key of the queryable that takes a `RigRequest` and answers with the `RigMessage` in force.

    A key of its own, because access rights cannot tell a query with a payload from one without.
    """
    return f"{arena}/rig/set"


def rig_step_key(arena: str, step: Step) -> str:
    """The key of the queryable that takes a `RigStepRequest`, and undoes the last change or redoes what was undone."""
    return f"{arena}/rig/{step}"


def rig_history_key(arena: str) -> str:
    """The key of the queryable that answers with the `RigHistory`."""
    return f"{arena}/rig/history"
