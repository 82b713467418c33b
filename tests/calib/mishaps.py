# SPDX-License-Identifier: BSD-3-Clause
"""What goes wrong with recordings that people make: mis-clicks, swapped ends, reflections, gaps, lenses roughly known.

Every function takes messages or a rig and returns other ones; faults come in runs, as they do.
"""

from collections.abc import Callable, Sequence

import msgspec
import numpy as np

from calib.rig.rig import Rig
from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections

Change = Callable[[Roundels, Detections], Roundels]


def in_runs(
    messages: Sequence[Detections], share: float, run: float, change: Change, seed: int = 0
) -> list[Detections]:
    """Messages of which each camera has a `share` changed, in runs of `run` frames on average."""
    rng, state, changed = np.random.default_rng([11, seed]), {}, []
    for message in sorted(messages, key=lambda m: (m.camera, m.t_ns)):
        on = state.get(message.camera, rng.random() < share)
        leave = 1 / run if on else share / (1 - share) / run
        state[message.camera] = on = on ^ (rng.random() < leave)
        changed.append(repack(message, change(message.unpack(), message)) if on else message)
    return sorted(changed, key=lambda m: m.t_ns)


def repack(message: Detections, roundels: Roundels) -> Detections:
    """The message with other roundels."""
    header = {name: getattr(message, name) for name in ("camera", "seq", "t_ns", "width", "height")}
    return Detections.pack(roundels, **header)


def swap_ends(roundels: Roundels, _: Detections) -> Roundels:
    """Numbers the other way round."""
    return altered(roundels, id=(roundels.id.max(initial=0) - roundels.id).astype(np.int32))


def altered(roundels: Roundels, **columns) -> Roundels:
    """Roundels with other columns."""
    kept = {name: getattr(roundels, name) for name in Roundels.__slots__}
    return Roundels(**{**kept, **columns})


def onto_a_feature(roundels: Roundels, message: Detections) -> Roundels:
    """One marker is clicked on a feature that stays where it is, another one in every camera."""
    rng = np.random.default_rng([*message.camera.encode()])
    place, uv = rng.uniform([0, 0], [message.width, message.height]), roundels.uv.copy()
    uv[roundels.id == 0] = place
    return altered(roundels, uv=uv)


def anywhere(rng: np.random.Generator) -> Change:
    """Clicks that hit nothing."""

    def change(roundels: Roundels, message: Detections) -> Roundels:
        uv = roundels.uv.copy()
        if len(uv):
            uv[rng.integers(len(uv))] = rng.uniform([0, 0], [message.width, message.height])
        return altered(roundels, uv=uv)

    return change


def in_a_mirror(roundels: Roundels, message: Detections) -> Roundels:
    """A light is seen in a shiny wall: elsewhere, moving the other way."""
    u, v = roundels.uv.T
    uv = np.column_stack([np.abs(1.3 * message.width - u) % message.width, 0.8 * v + 0.1 * message.height])
    return altered(roundels, uv=uv)


def nothing(roundels: Roundels, _: Detections) -> Roundels:
    """The wand is not seen."""
    return roundels.select(np.zeros(len(roundels), bool))


def roughly(rig: Rig, focal: float, centre_px: float, distortion: bool, seed: int = 0) -> Rig:
    """Lenses as somebody guessed them: focal lengths and centres off by these standard deviations, and perhaps no
    distortion."""
    rng, cameras = np.random.default_rng([13, seed]), {}
    for name, camera in rig.cameras.items():
        factor, shift = np.exp(focal * rng.standard_normal()), centre_px * rng.standard_normal(2)
        cameras[name] = msgspec.structs.replace(
            camera,
            fx=camera.fx * factor,
            fy=camera.fy * factor,
            cx=camera.cx + shift[0],
            cy=camera.cy + shift[1],
            distortion=camera.distortion if distortion else (),
        )
    return Rig(cameras=cameras)
