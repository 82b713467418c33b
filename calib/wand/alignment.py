# SPDX-License-Identifier: BSD-3-Clause
"""Clocks of cameras that differ by seconds or minutes, or run at other rates: found from the motion, before any lens.

Two affine cameras see the same motion if one linear combination of the image velocity in the first equals one in the
second: at the right shift and rate of the clocks, the largest canonical correlation (Hotelling 1936) of the two
velocities is near 1, whatever the cameras' poses, lenses and mirrored images. For a trial rate, the moments at all
shifts are correlations by FFT. A slow hand and perspective make other shifts nearly as good, so the best ones are only
proposed: the epipolar geometry that fits all images at one of them to their noise decides
(docs/design/wand_adjustment.md, section 8).
"""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from calib.rig.coverage import spread_evenly
from calib.rig.estimation import GROSS, MARGIN
from calib.rig.rig import Rig
from calib.wand.body_poses import SIGMA_RAD
from calib.wand.bundle_adjustment.problem import SLEWED_DRIFT
from calib.wand.detections import FrameTable, MarkerTrack, Timing, WandDetections, gather, interpolate
from calib.wand.initial_rig import MAX_SHIFT_S, MIN_MISFIT, SHIFT_SAMPLE, epipolar_misfits
from camera_node.foundation.arrays import Array, Mask
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

GRID_S = 1 / 30  # between samples
STEP_S = 0.1  # over which velocities are averaged: a hand moves below 2 Hz
MAX_RATE = 0.03  # by which two clocks may differ: 29.97 frames a second read as 30 or 29, 24 as 25 is beyond
MAX_TRACKS = 8  # markers of which each camera's velocity is used
FEW = 8.0  # independent samples, which a correlation of two by two coordinates needs
# Shifts and rates that are judged; of each pair that was tried the right one was among the best 103
PROPOSALS = 128
REFINED = 4  # proposals that are refined
# By which the logarithm of the likelihood of the right one exceeds that of others: at most 29 in 240 pairs of cameras
# that saw different motions, at least 40 in 15 s of a light and 75 in 10 s of a wand.
LEAD = 36.0
FITTED = 9  # parameters: of a fundamental matrix, the shift and the rate
SLIM = 1e-4  # of the variance, that motion across a line has at the least
REFINEMENTS, ACROSS = 6, 5  # grids of trial shifts and rates around the best one, each half as wide

Spectrum = NDArray[np.complex128]
Spectra = tuple[Spectrum, Spectrum, Spectrum]


@dataclass(frozen=True, slots=True)
class ClockMap:
    """Corrected stamp = stamp + offset + rate (stamp - reference), seconds."""

    offset_s: float
    rate: float


@dataclass(frozen=True, slots=True)
class Alignment:
    """Maps of the stamps of cameras, by name, into the clock that most cameras share.

    Attributes:
        reference_ns: stamp at which the offsets hold.
        maps: of the cameras whose clocks differ by more than an adjustment estimates by itself.
    """

    reference_ns: int
    maps: dict[str, ClockMap]

    def start_s(self, messages: Sequence[Detections]) -> float:
        """The first corrected stamp, seconds after the reference."""
        return 1e-9 * (min(m.t_ns for m in self.apply(messages)) - self.reference_ns)

    def apply(self, messages: Sequence[Detections]) -> list[Detections]:
        """The messages with corrected stamps."""
        return [
            msgspec.structs.replace(m, t_ns=self._corrected(m.t_ns, found)) if found else m
            for m in messages
            for found in [self.maps.get(m.camera)]
        ]

    def _corrected(self, t_ns: int, found: ClockMap) -> int:
        return t_ns + round(1e9 * found.offset_s + found.rate * (t_ns - self.reference_ns))

    def sentence(self) -> str:
        """How the clocks differ."""
        return "; ".join(f"camera '{name}' {_describe(found)}" for name, found in self.maps.items())


def _describe(found: ClockMap) -> str:
    later = "later" if found.offset_s < 0 else "earlier"
    shift = f"the stamps are {abs(found.offset_s):.1f} s {later} than those of the others"
    fast = "fast" if found.rate < 0 else "slow"
    return f"{shift}, its clock is {1e2 * abs(found.rate):.2f} % too {fast}" if found.rate else shift


def align_clocks(rig: Rig, wand: Body, messages: Sequence[Detections]) -> Alignment:
    """Find clocks that differ by more than an adjustment estimates by itself.

    Clocks of running cameras, which state a bound of their error, are not tried.

    Args:
        rig: the lenses.
        wand: its number of markers tells the frames of unnumbered points that show all of it.
        messages: the recording.
    """
    stamps = [m.t_ns for m in messages]
    reference_ns = (min(stamps) + max(stamps)) // 2
    if all(m.clock_error_us > 0 for m in messages):
        return Alignment(reference_ns, {})
    names = sorted({m.camera for m in messages})
    frames, detections = gather(messages, names, [rig.cameras[name] for name in names], wand.codes)
    frames = replace(frames, t_s=frames.t_s - (reference_ns - min(stamps)) * 1e-9)
    signals = {}
    for k, name in enumerate(names):
        signal = _Signal.of(frames, detections.select(detections.camera == k), k, len(wand.markers))
        if signal is not None:
            signals[name] = signal
    return Alignment(reference_ns, _relative_to_most(_chain(signals)))


@dataclass(frozen=True, slots=True)
class _Signal:
    """The image motion of one camera: tracks by marker, seconds after the reference, and how its frames follow."""

    tracks: dict[int, MarkerTrack]
    timing: Timing

    @classmethod
    def of(cls, frames: FrameTable, found: WandDetections, camera: int, markers: int) -> "_Signal | None":
        """The signal of a camera's detections: of the markers that it sees most, or of the middle of a wand without
        numbers in the frames that show as many points as it has; None without motion."""
        t_s, label, xy = frames.t_s[found.frame], found.label, found.xy
        if not (label >= 0).any():
            frame, start, count = np.unique(found.frame, return_index=True, return_counts=True)
            whole = count == markers
            xy = np.add.reduceat(xy, start)[whole] / markers if len(start) else xy
            t_s, label = frames.t_s[frame[whole]], np.zeros(int(whole.sum()), np.intp)
        most = np.argsort(-np.bincount(label[label >= 0], minlength=1))[:MAX_TRACKS]
        tracks = {}
        for number in most.tolist():
            rows = np.flatnonzero(label == number)
            rows = rows[np.diff(t_s[rows], prepend=-np.inf) > 0]
            if len(rows) > 1:
                tracks[number] = MarkerTrack.of(t_s[rows], xy[rows])
        period_s = frames.select(frames.camera == camera).period_s()
        return cls(tracks, Timing(period_s)) if tracks and period_s else None

    @property
    def step_s(self) -> float:
        """The time over which the image's motion is compared."""
        return max(self.timing.period_s, STEP_S)

    @property
    def span(self) -> tuple[float, float]:
        """The first and the last time."""
        ends = [(t.t_s[0], t.t_s[-1]) for t in self.tracks.values()]
        return float(min(a for a, _ in ends)), float(max(b for _, b in ends))

    def velocities(self, label: int, t_s: Array, step_s: float) -> Array:
        """(n, 2) mean velocities of a marker's image over a step around times (n,); 0 where it was not seen."""
        track, gap_s = self.tracks[label], self.timing.gap_s
        moved = track.interpolate(t_s + step_s / 2, gap_s) - track.interpolate(t_s - step_s / 2, gap_s)
        limit = GROSS * np.nanmedian(np.abs(moved)) if np.isfinite(moved).any() else 0.0
        return np.nan_to_num(np.clip(moved, -limit, limit))


def _chain(signals: dict[str, _Signal]) -> dict[str, ClockMap]:
    """Maps of the cameras into the clock of the one that has the longest tracks, directly or by others: first by clocks
    of one rate, which are soon tried, then by clocks of any."""
    order = sorted(signals, key=lambda name: -sum(len(t.t_s) for t in signals[name].tracks.values()))
    maps = {name: ClockMap(0.0, 0.0) for name in order[:1]}
    for max_rate in (0.0, MAX_RATE):
        reached = list(maps)
        for a in reached:  # grows
            for b in [name for name in order if name not in maps]:
                match = _match(signals[a], signals[b], max_rate)
                if match is not None:
                    (shift_s, rate), known = match.tolist(), maps[a]
                    scale = 1 / (1 + rate)
                    shift_s *= (1 + known.rate) * scale
                    maps[b] = ClockMap(known.offset_s - shift_s, (1 + known.rate) * scale - 1)
                    reached.append(b)
    return maps


def _relative_to_most(maps: dict[str, ClockMap]) -> dict[str, ClockMap]:
    """The maps into the clock that most cameras share, without those whose clocks are the same."""

    def differs(one: ClockMap, other: ClockMap) -> bool:
        return (
            abs(one.offset_s - other.offset_s) > MAX_SHIFT_S / 2 or abs(one.rate - other.rate) > SLEWED_DRIFT
        )

    if not maps:
        return {}
    middle_s = float(np.median([m.offset_s for m in maps.values()]))
    shared = max(
        maps.values(),
        key=lambda m: (sum(not differs(m, o) for o in maps.values()), -abs(m.offset_s - middle_s)),
    )
    # c = t + o + r t of the first camera's clock becomes (c - o_s) / (1 + r_s).
    relative = {
        name: ClockMap(
            (m.offset_s - shared.offset_s) / (1 + shared.rate), (1 + m.rate) / (1 + shared.rate) - 1
        )
        for name, m in maps.items()
        if differs(m, shared)
    }
    return {
        name: m if abs(m.rate) > SLEWED_DRIFT else ClockMap(m.offset_s, 0.0) for name, m in relative.items()
    }


def _match(a: _Signal, b: _Signal, max_rate: float) -> Array | None:
    """The shift and the rate (2,) under which two cameras show the same motion; None unless they explain it far better
    than any others. The stamp of b that belongs to a stamp t of a is t (1 + rate) + shift.

    Affine cameras propose: the largest canonical correlations over all shifts, and rates up to `max_rate`. Perspective
    decides: at the right shift and rate, one epipolar geometry fits all images to their noise.
    """
    labels = [label for label in a.tracks if label in b.tracks]
    if not labels:
        return None
    grid_s, step_s = max(a.timing.period_s, b.timing.period_s, GRID_S), max(a.step_s, b.step_s)
    width_s = _width(a, list(a.tracks), grid_s, step_s)
    rate_step = min(MAX_RATE, width_s / min(float(np.ptp(a.span)), float(np.ptp(b.span))))
    rates = np.linspace(-max_rate, max_rate, 2 * int(np.ceil(max_rate / rate_step)) + 1).tolist()
    proposed = _propose(list(_trials(a, b, labels, (grid_s, step_s, width_s), rates)), 2 * width_s, rate_step)
    geometry = _Epipolar(a, b, labels, width_s, proposed)
    scores = geometry.scores(proposed)
    best = [k for k in np.argsort(-scores)[:REFINED].tolist() if scores[k] > 0]
    if not best:
        return None
    for k in best:
        proposed[k] = geometry.refine(proposed[k], rate_step)
    scores[best] = geometry.scores(proposed[best])
    first = int(scores.argmax())
    found = proposed[first]
    others = np.abs((proposed - found) @ [1.0, float(np.mean(a.span))]) > 2 * width_s
    lead = scores[first] - scores.max(initial=0.0, where=others)
    if lead < LEAD or geometry.misfit(found) > SIGMA_RAD:
        return None
    same_rate = geometry.with_same_rate(found)
    by_rate = geometry.gain(found, same_rate)
    if by_rate < MARGIN:
        return same_rate
    halves = geometry.halves(found)
    jumped = sum(half.gain(half.with_same_rate(found), found) for half in halves)
    return found if jumped < MARGIN and by_rate > LEAD else None


def _propose(trials: Sequence[tuple[Array, Array, float]], apart_s: float, apart: float) -> Array:
    """(P, 2) shifts, seconds, and rates of the trials with most evidence, of those near each other the best one.

    Args:
        trials: evidence (n,), shifts (n,) and the rate.
        apart_s, apart: least differences of shifts and rates.
    """
    evidence, shifts = (np.concatenate([trial[k] for trial in trials]) for k in (0, 1))
    rates = np.repeat([rate for *_, rate in trials], [len(trial[0]) for trial in trials])
    waiting, chosen = np.argsort(-evidence), []
    while len(waiting) and len(chosen) < PROPOSALS:
        k = waiting[0]
        chosen.append(k)
        near = (np.abs(shifts[waiting] - shifts[k]) < apart_s) & (np.abs(rates[waiting] - rates[k]) <= apart)
        waiting = waiting[~near]
    return np.column_stack([shifts[chosen], rates[chosen]])


class _Epipolar:
    """Judges shifts and rates of the clocks of two cameras by the epipolar geometry that fits their images best.

    Args:
        a, b: the cameras.
        labels: markers of both.
        width_s: time within which the motion is alike.
        proposed: (P, 2) shifts and rates, most of which are wrong.
    """

    def __init__(
        self, a: _Signal, b: _Signal, labels: Sequence[int], width_s: float, proposed: Array
    ) -> None:
        t_s = np.concatenate([a.tracks[label].t_s for label in labels])
        index = np.repeat(np.arange(len(labels)), [len(a.tracks[label].t_s) for label in labels])
        rows = spread_evenly(len(t_s), SHIFT_SAMPLE)
        self.t_s, self.index = t_s[rows], index[rows]
        self.xy = np.concatenate([a.tracks[label].xy for label in labels])[rows]
        self.tracks, self.gap_s = [b.tracks[label] for label in labels], b.timing.gap_s
        self.width_s = width_s
        # Samples of a marker are independent after pi widths, and two markers of a rigid wand at one time.
        self.sample = np.floor((self.t_s - self.t_s.min()) / (np.pi * width_s)).astype(np.intp)
        self.independent = min(2, len(labels))
        misfits = self._misfits(proposed)[0]
        self.usual = float(np.median(misfits[np.isfinite(misfits)])) if np.isfinite(misfits).any() else 0.0

    def scores(self, matches: Array) -> Array:
        """(P,) logarithms of the likelihood of shifts and rates (P, 2) over that of the usual proposal."""
        misfits, known = self._misfits(matches)
        seen = np.zeros((len(matches), self.sample.max() + 1), bool)
        match, row = np.nonzero(known)
        seen[match, self.sample[row]] = True
        count = np.maximum(self.independent * seen.sum(axis=1) - FITTED, 0)
        return count * np.log((self.usual + MIN_MISFIT) / (np.minimum(misfits, self.usual) + MIN_MISFIT))

    def refine(self, match: Array, rate_step: float) -> Array:
        """The best shift and rate (2,) near a trial, by grids that get finer; in the middle of what both saw, shift and
        rate are independent."""
        middle_s = self.middle_s(match)
        x, y = (grid.ravel() for grid in np.meshgrid(*2 * [np.linspace(-1, 1, ACROSS)]))
        for step in 0.5 ** np.arange(REFINEMENTS):
            shift, rate = step * self.width_s * x, 2 * step * rate_step * y
            trials = match + np.column_stack([shift - middle_s * rate, rate])
            match = trials[int(self._misfits(trials)[0].argmin())]
        return match

    def gain(self, match: Array, other: Array) -> float:
        """By which the score of one shift and rate (2,) exceeds that of another."""
        return float(self.scores(match[None])[0] - self.scores(other[None])[0])

    def with_same_rate(self, match: Array) -> Array:
        """The best shift (2,) near a trial of clocks that run alike."""
        return self.refine(np.array([match @ [1.0, self.middle_s(match)], 0.0]), 0.0)

    def halves(self, match: Array) -> "tuple[_Epipolar, _Epipolar]":
        """Of what both cameras saw, before and after its middle: a clock that jumps has one rate in both."""
        known = self._misfits(match[None])[1][0]
        is_late = self.t_s > self.middle_s(match)
        parts = copy(self), copy(self)
        for part, rows in zip(parts, (known & ~is_late, known & is_late), strict=True):
            part.t_s, part.index, part.xy = self.t_s[rows], self.index[rows], self.xy[rows]
            part.sample = self.sample[rows]
        return parts

    def middle_s(self, match: Array) -> float:
        """The mean time of what both cameras saw."""
        return float(np.mean(self.t_s[self._misfits(match[None])[1][0]]))

    def misfit(self, match: Array) -> float:
        """Median distance of the images from the epipolar geometry, image plane."""
        return float(self._misfits(match[None])[0][0])

    def _misfits(self, matches: Array) -> tuple[Array, Mask]:
        """(P,) median distances from the epipolar geometry, and (P, n) which images have a counterpart."""
        times = self.t_s * (1 + matches[:, 1:]) + matches[:, :1]
        there = interpolate(self.tracks, self.index, times, self.gap_s)
        return epipolar_misfits(self.xy, there), np.isfinite(there[..., 0])


def _width(a: _Signal, labels: Sequence[int], grid_s: float, step_s: float) -> float:
    """The time within which the motion of a camera's image is alike: the inverse of its bandwidth, 1 / (2 pi f)."""
    at = np.arange(a.span[0], a.span[1] + grid_s, grid_s)
    spectra = np.fft.rfft([a.velocities(label, at, step_s) for label in labels], axis=1)
    power = (np.abs(spectra) ** 2).sum(axis=(0, 2))
    f = np.fft.rfftfreq(len(at), grid_s)
    return float(1 / (2 * np.pi * np.sqrt((power @ f**2) / max(power.sum(), 1e-300)) + 1e-9))


def _trials(
    a: _Signal,
    b: _Signal,
    labels: Sequence[int],
    scales_s: tuple[float, float, float],
    rates: Sequence[float],
) -> Iterator[tuple[Array, Array, float]]:
    """The evidence (n,) of shifts (n,), seconds, for each trial rate, and the rate."""
    (grid_s, step_s, width_s), (first, last), (start, end) = scales_s, a.span, b.span
    at_a = np.arange(first, last + grid_s, grid_s)
    size = int(2 ** np.ceil(np.log2(len(at_a) + (end - start) * (1 + MAX_RATE) / grid_s + 2)))
    f_a = _spectra([a.velocities(label, at_a, step_s) for label in labels], size)
    for rate in rates:
        at_b = np.arange(start / (1 + rate), end / (1 + rate) + grid_s, grid_s)
        f_b = _spectra([b.velocities(label, at_b * (1 + rate), step_s) for label in labels], size)
        lags = np.fft.fftfreq(size, 1 / size) * grid_s + at_b[0] - at_a[0]
        yield _evidence(f_a, f_b, size, grid_s / (np.pi * width_s)), lags * (1 + rate), rate


def _spectra(velocities: Sequence[Array], size: int) -> Spectra:
    """Spectra of the velocities (m, 2, f), of their products xx, xy, yy (m, 3, f), and of the mask (m, f)."""
    v = np.array(velocities) / max(float(np.std(velocities)), 1e-300)
    products = np.stack([v[..., 0] ** 2, v[..., 0] * v[..., 1], v[..., 1] ** 2], axis=1)
    mask = (v != 0).any(axis=2).astype(float)
    return np.fft.rfft(v.swapaxes(1, 2), size), np.fft.rfft(products, size), np.fft.rfft(mask, size)


def _evidence(a: Spectra, b: Spectra, size: int, independent: float) -> Array:
    """(n,) -count log(1 - r^2) of the largest canonical correlation r at all lags of b after a."""

    def correlate(first: Spectrum, second: Spectrum) -> Array:
        return np.fft.irfft((np.conj(first) * second).sum(axis=0), size)

    count = np.maximum(correlate(a[2], b[2]), 0.0)
    aa = [correlate(a[1][:, k], b[2]) for k in range(3)]
    bb = [correlate(a[2], b[1][:, k]) for k in range(3)]
    ab = np.array([[correlate(a[0][:, i], b[0][:, j]) for j in range(2)] for i in range(2)])
    return _canonical(np.array(aa), np.array(bb), ab, count * independent)


def _canonical(aa: Array, bb: Array, ab: Array, count: Array) -> Array:
    """-count log(1 - r^2) from the moments (3, n), (3, n) and (2, 2, n); 0 where there are too few samples."""
    enough = count > FEW
    evidence = np.zeros(count.shape)
    inverses = []
    for xx, xy, yy in (aa[:, enough], bb[:, enough]):
        trace = xx + yy
        det = np.maximum(xx * yy - xy**2, SLIM * trace**2)
        inverses.append(np.array([[yy, -xy], [-xy, xx]]) / np.maximum(det, 1e-300))
    ab = ab[:, :, enough]
    M = np.einsum("ijn,jkn,kln,mln->imn", inverses[0], ab, inverses[1], ab)
    half, det = (M[0, 0] + M[1, 1]) / 2, M[0, 0] * M[1, 1] - M[0, 1] * M[1, 0]
    squared = half + np.sqrt(np.maximum(half**2 - det, 0.0))
    evidence[enough] = -(count[enough] - FEW) * np.log1p(-np.clip(squared, 0.0, 1 - 1e-6))
    return evidence
