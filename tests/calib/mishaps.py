# SPDX-License-Identifier: BSD-3-Clause
"""Typical faults of wand recordings: wrong clicks, swapped ends, reflections and gaps, for consecutive frames."""

from collections.abc import Callable, Sequence

import numpy as np

from camera_node.detection.roundels import Roundels
from camera_node.protocol.messages import Detections

Change = Callable[[Roundels, Detections], Roundels]


def in_runs(
    messages: Sequence[Detections], share: float, run: float, change: Change, seed: int = 0
) -> list[Detections]:
    """Change a `share` of each camera's messages, in runs of `run` frames on average."""
    rng, state, changed = np.random.default_rng([11, seed]), {}, []
    for message in sorted(messages, key=lambda m: (m.camera, m.t_ns)):
        on = state.get(message.camera, rng.random() < share)
        leave = 1 / run if on else share / (1 - share) / run
        state[message.camera] = on = on ^ (rng.random() < leave)
        changed.append(repack(message, change(message.unpack(), message)) if on else message)
    return sorted(changed, key=lambda m: m.t_ns)


def repack(message: Detections, roundels: Roundels) -> Detections:
    """Return the message with other roundels."""
    header = {name: getattr(message, name) for name in ("camera", "seq", "t_ns", "width", "height")}
    return Detections.pack(roundels, **header)


def swap_ends(roundels: Roundels, _: Detections) -> Roundels:
    """Reverse the marker numbers."""
    return altered(roundels, id=(roundels.id.max(initial=0) - roundels.id).astype(np.int32))


def altered(roundels: Roundels, **columns) -> Roundels:
    """Return the roundels with other columns."""
    return Roundels(**({name: getattr(roundels, name) for name in Roundels.__slots__} | columns))


def onto_a_feature(roundels: Roundels, message: Detections) -> Roundels:
    """Move marker 0 onto a fixed image point, another one in each camera."""
    rng = np.random.default_rng([*message.camera.encode()])
    place, uv = rng.uniform([0, 0], [message.width, message.height]), roundels.uv.copy()
    uv[roundels.id == 0] = place
    return altered(roundels, uv=uv)


def anywhere(rng: np.random.Generator) -> Change:
    """Return a change that moves one roundel to a random pixel."""

    def change(roundels: Roundels, message: Detections) -> Roundels:
        uv = roundels.uv.copy()
        if len(uv):
            uv[rng.integers(len(uv))] = rng.uniform([0, 0], [message.width, message.height])
        return altered(roundels, uv=uv)

    return change


def in_a_mirror(roundels: Roundels, message: Detections) -> Roundels:
    """Replace a light by its reflection in a wall, which moves in the opposite direction."""
    u, v = roundels.uv.T
    uv = np.column_stack([np.abs(1.3 * message.width - u) % message.width, 0.8 * v + 0.1 * message.height])
    return altered(roundels, uv=uv)


def nothing(roundels: Roundels, _: Detections) -> Roundels:
    """Remove all roundels."""
    return roundels.select(np.zeros(len(roundels), bool))
