# SPDX-License-Identifier: BSD-3-Clause
"""Roundels under uneven light: shares found, and errors over claims.

Each card has a disturbance of its own in place and direction. A camera sees every kind for itself, with a detector
that has learned it from evenly lit roundels first.
"""

from collections.abc import Iterator

import numpy as np
from rich.console import Console

from camera_node.foundation.arrays import Array
from camera_node.simulation.sensor import Sensor
from tests.benchmarks.detector.cameras import Disturb, acquainted, errors
from tests.benchmarks.detector.pictures import Card
from tests.benchmarks.detector.table import Run, Verdict, table

BAND = (20, 60)  # pixels
SHADOW, PENUMBRA = 0.5, 0.25  # share of the light that a shadow takes; half width of its edge, diameters
GLOSS, HIGHLIGHT = 60.0, 0.3  # grey levels that a highlight adds; its standard deviation, diameters
NOISE = Sensor(noise=3.0)


def even(light: Array, cards: list[Card], rng: np.random.Generator) -> Array:
    """The light as it is."""
    return light


def soft_shadow(
    light: Array, cards: list[Card], rng: np.random.Generator, penumbra: float = PENUMBRA
) -> Array:
    """The straight edge of a soft shadow across each card."""
    out = light.copy()
    for card, x, y in _surroundings(light, cards):
        turn, at = rng.uniform(0, 2 * np.pi), rng.uniform(-0.5, 0.5)
        across = (np.cos(turn) * x + np.sin(turn) * y) / card.diameter - at
        out[_box(light, card)] *= 1 - SHADOW * np.clip(0.5 + across / (2 * penumbra), 0, 1)
    return out


def gloss(light: Array, cards: list[Card], rng: np.random.Generator, level: float = GLOSS) -> Array:
    """A highlight on each card, which adds the same light to ink and paper, up to this grey level."""
    out = light.copy()
    for card, x, y in _surroundings(light, cards):
        u, v = rng.uniform(-0.5, 0.5, 2) * card.diameter
        squared = ((x - u) ** 2 + (y - v) ** 2) / (HIGHLIGHT * card.diameter) ** 2
        out[_box(light, card)] += level * np.exp(-squared / 2)
    return out


def _box(light: Array, card: Card) -> tuple[slice, slice]:
    (u, v), reach = card.uv, 1.2 * card.diameter
    return (
        slice(max(0, int(v - reach)), int(v + reach) + 1),
        slice(max(0, int(u - reach)), int(u + reach) + 1),
    )


def _surroundings(light: Array, cards: list[Card]) -> Iterator[tuple[Card, Array, Array]]:
    """For each card the coordinates of the pixels around it, relative to its centre."""
    for card in cards:
        rows, columns = _box(light, card)
        y, x = np.mgrid[
            rows.start : min(rows.stop, light.shape[0]), columns.start : min(columns.stop, light.shape[1])
        ]
        yield card, x - card.uv[0], y - card.uv[1]


# What disturbs: the camera, the light, and the greatest mean squared error of the centre over its claim, for each
# coordinate.
KINDS: dict[str, tuple[Sensor, Disturb, float]] = {
    "none": (NOISE, even, 1.5),
    "vignetting of 0.5": (Sensor(noise=3.0, vignetting=0.5), even, 1.5),
    "shading of 0.5": (Sensor(noise=3.0, shading=0.5), even, 1.5),
    "smoothing": (Sensor(noise=3.0, denoise_px=1.0), even, 1.5),
    "soft shadow": (NOISE, soft_shadow, 2.0),
    "gloss": (NOISE, gloss, 2.5),
}


def measure(run: Run, console: Console) -> list[Verdict]:
    """Print all kinds of light and return the verdicts on their goals."""
    frames = 40 if run.thorough else 5
    done = {
        what: errors(acquainted(run, sensor), sensor, BAND, frames, disturb)
        for what, (sensor, disturb, _) in KINDS.items()
    }
    rows = [(what, f"{e.found:.2f}", f"{e.centre:.1f}", f"{e.size:.1f}") for what, e in done.items()]
    title = f"{run.name}: uneven light, {BAND[0]} to {BAND[1]} px, squared errors over claims"
    console.print(table(title, ("", "found", "centre²/claim", "size²/claim"), rows))
    return [
        Verdict(
            f"{what}, squared error over claim", f"{e.centre:.1f}", f"<= {limit:g}", bool(e.centre <= limit)
        )
        for (what, e), (_, _, limit) in zip(done.items(), KINDS.values(), strict=True)
    ]
