# SPDX-License-Identifier: BSD-3-Clause
"""Follows the calibration in force, so that a node's detections use the camera's lens."""

import logging
from collections.abc import Callable
from typing import ClassVar

import msgspec
import zenoh

from camera_node.detection.known_lens import KnownLens
from camera_node.detection.roundels import DetectedRoundels, Roundels
from camera_node.foundation.errors import ConfigError
from camera_node.geometry.lens import Lens
from camera_node.protocol.messages import VERSION, Keys, MessageError, decode
from camera_node.protocol.requests import REQUEST_S
from camera_node.protocol.session import guarded, is_from_router

log = logging.getLogger("camera_node")


class RigLens:
    """The lens of one camera in the server's rig, as it changes; detections are unchanged while there is none.

    The server is asked whenever it appears, and publishes each change.

    Args:
        session: an open Zenoh session.
        keys: the arena's.
        camera: its name.
        on_refusal: called after a message that is no rig, on Zenoh's thread.
    """

    def __init__(
        self, session: zenoh.Session, keys: Keys, camera: str, on_refusal: Callable[[], object] = lambda: None
    ) -> None:
        self._on_refusal = on_refusal
        self._session, self._key, self._camera = session, keys.rig, camera
        self._known: KnownLens | None = None
        self._reported = False  # that the lens is wrong
        self._closed = False
        purpose = f"reading {keys.rig}"
        self._rig = session.declare_subscriber(
            keys.rig, guarded(purpose, lambda sample: self._receive(sample.payload.to_bytes()))
        )
        self._server = session.liveliness().declare_subscriber(
            keys.fusion_alive, guarded(purpose, self._ask), history=True
        )

    @property
    def lens(self) -> Lens | None:
        """The camera's lens in the rig in force; None if there is none."""
        return self._known.lens if self._known is not None else None

    def refine(self, roundels: DetectedRoundels, size: tuple[int, int]) -> Roundels:
        """The roundels of a frame of this size (width, height) as the lens shows them, if it is known."""
        known = self._known
        if known is None or not len(roundels) or not self._fits(known.lens, size):
            return roundels
        refined = known.refine(roundels)
        if known.contradicted and not self._reported:
            self._reported = True
            log.warning(
                "the lens of %s in the rig contradicts its roundels and is not used for detection; if lens, focus or "
                "zoom were changed, calibrate it again: roundel calibrate intrinsics --camera %s",
                self._camera,
                self._camera,
            )
        return refined

    def close(self) -> None:
        """End following; the lens is forgotten, because Zenoh may hold callbacks until Python ends."""
        self._closed = True
        self._server.undeclare()
        self._rig.undeclare()
        self._known = None

    def _fits(self, lens: Lens, size: tuple[int, int]) -> bool:
        if size == (lens.width, lens.height):
            return True
        if not self._reported:
            self._reported = True
            log.warning(
                "the images of %s have %d x %d px, but its lens in the rig is for %d x %d px: it is not used for "
                "detection",
                self._camera,
                *size,
                lens.width,
                lens.height,
            )
        return False

    def _ask(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        every = zenoh.ConsolidationMode.NONE
        answer = guarded(f"reading {self._key}", self._answered)
        self._session.get(self._key, answer, timeout=REQUEST_S, consolidation=every)

    def _answered(self, reply: zenoh.Reply) -> None:
        """Use the reply: the server's in preference to that of another program."""
        if reply.ok is not None and (self._known is None or is_from_router(self._session, reply)):
            self._receive(reply.ok.payload.to_bytes())

    def _receive(self, payload: bytes) -> None:
        try:
            lens = decode(payload, RigLenses).rig.cameras.get(self._camera)
            known = self._known
            if not self._closed and (lens is None or known is None or lens != known.lens):
                self._reported = False
                self._known = KnownLens(lens) if lens is not None else None
        except MessageError:
            self._on_refusal()
        except ConfigError as error:
            log.warning("the lens of %s in the rig is not used: %s", self._camera, error)


class RigLenses(msgspec.Struct, frozen=True, kw_only=True):
    """The lenses in a `RigMessage`, which `calib` defines and the server publishes; other fields are skipped."""

    class Cameras(msgspec.Struct, frozen=True):
        """The part of a rig."""

        cameras: dict[str, Lens]

    MAX_BYTES: ClassVar[int] = 1 << 20  # that of a `RigMessage`
    version: int = VERSION
    rig: Cameras
