# SPDX-License-Identifier: BSD-3-Clause
"""The messages of calibration on Zenoh, encoded as in `camera_node.protocol.messages`, and their keys."""

from typing import Annotated, ClassVar, Literal

import msgspec

from calib.rig.changes import RigChange
from calib.rig.rig import Rig
from camera_node.protocol.messages import VERSION, MessageError
from camera_node.protocol.requests import RequestSource

MAX_VERSIONS = 64  # in one history
MAX_RIG_BYTES = 1 << 20  # of a message; 256 cameras with their reports take a quarter


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
    """Asks the server to undo the last change of the rig, or to redo the change that was undone last."""

    version: int = VERSION
    source: RequestSource | None = None


class RigVersion(RigChange, frozen=True, kw_only=True, omit_defaults=False):
    """A version of the rig: the change that made it, and the server's file that holds it."""

    state: Literal["earlier", "in force", "undone"]
    file: Annotated[str, msgspec.Meta(max_length=255)] = ""  # empty if a restart loses it

    @property
    def unnamed_maker(self) -> str:
        """Who made it, where `source` does not say so."""
        return "the server" if self.is_correction else "the server or a file"


class RigHistory(msgspec.Struct, frozen=True, kw_only=True):
    """The versions of the rig in their order, oldest first: the earlier ones, the one in force, the undone ones."""

    version: int = VERSION
    rig_t_ns: int | None = None  # `t_ns` of the `RigMessage` in force; None without a rig
    versions: Annotated[tuple[RigVersion, ...], msgspec.Meta(max_length=MAX_VERSIONS)] = ()


def set_rig_key(arena: str) -> str:
    """The key of the queryable that takes a `RigRequest` and answers with the `RigMessage` in force.

    A key of its own, because access rights cannot tell a query with a payload from one without.
    """
    return f"{arena}/rig/set"


def undo_rig_key(arena: str) -> str:
    """The key of the queryable that takes a `RigStepRequest` and restores the rig before the last change."""
    return f"{arena}/rig/undo"


def redo_rig_key(arena: str) -> str:
    """The key of the queryable that takes a `RigStepRequest` and restores the rig that was undone last."""
    return f"{arena}/rig/redo"


def rig_history_key(arena: str) -> str:
    """The key of the queryable that answers with the `RigHistory`."""
    return f"{arena}/rig/history"
