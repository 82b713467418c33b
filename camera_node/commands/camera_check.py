# SPDX-License-Identifier: BSD-3-Clause
"""`roundel camera --check`: reads a camera for some seconds and reports stamps, rate, losses, light and focus."""

import contextlib
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import msgspec
import numpy as np

from camera_node.commands.publish import open_source
from camera_node.detection.detector import Detector
from camera_node.detection.sharpness import edge_blur_px
from camera_node.foundation.arrays import Array
from camera_node.foundation.errors import CameraError
from camera_node.foundation.terminal import progress_bar, say
from camera_node.node.node_status import BLURRED_PX, advise, advise_focus
from camera_node.sources.frame import Frame, Source, SourceSettings, without_credentials

MAX_JITTER_MS = 1.0  # of the stamps; a robot at 1 m/s moves by 1 mm in this time
MAX_MISSING = 0.01  # share of the frames
FEW = 10  # frames below which nothing is said about stamps


class SourceReport(msgspec.Struct, frozen=True):
    """What was found; times in milliseconds, None where frames or roundels are too few.

    Attributes:
        source: as `--source`.
        frames: that were delivered; dropped, incomplete, lost_packets: as in the status.
        missing: frames that the stamps skip.
        jitter_ms: deviation of the intervals between stamps from whole periods that 95 % of them do not exceed.
        delay_ms: median from the stamp to the arrival; out_of_order: stamps that are not later than the one before.
        stated_error_ms: the largest bound of a stamp's error.
        roundels: in the last frame; edge_blur_px: of their edges.
        faults: what a user should change; empty if the camera is in order.
    """

    source: str
    frames: int
    seconds: float
    width: int
    height: int
    fps: float | None
    missing: int
    dropped: int
    incomplete: int
    lost_packets: int
    jitter_ms: float | None
    delay_ms: float | None
    out_of_order: int
    stated_error_ms: float
    exposure_us: float
    readout_us: float
    roundels: int
    edge_blur_px: float | None
    faults: tuple[str, ...]


@dataclass
class _Readings:
    """Stamps of the frames, and the last frame."""

    stamps: list[int] = field(default_factory=list)
    arrivals: list[int] = field(default_factory=list)
    errors_us: list[float] = field(default_factory=list)
    last: Frame | None = None

    def add(self, frame: Frame) -> None:
        self.stamps.append(frame.t_ns)
        self.arrivals.append(time.time_ns())
        self.errors_us.append(frame.error_us)
        self.last = frame


def check_cameras(
    sources: Sequence[str], settings: SourceSettings, seconds: float, as_json: bool, stop: threading.Event
) -> int:
    """Check cameras one after another and print a report of each; 1 if any has a fault."""
    reports = []
    for source in sources:
        if stop.is_set():
            break
        report = check_camera(source, settings, seconds, stop)
        reports.append(report)
        if not as_json:
            say(_text(report))
    if as_json:
        say(msgspec.json.format(msgspec.json.encode(reports)).decode())
    return 1 if any(report.faults for report in reports) else 0


def check_camera(
    text: str, settings: SourceSettings, seconds: float, stop: threading.Event | None = None
) -> SourceReport:
    """Read a camera for some seconds; raises CameraError or ConfigError where it does not open."""
    name = without_credentials(text)
    with contextlib.closing(open_source(text, settings)) as source, progress_bar(f"reading {name}") as show:
        readings = _read(source, seconds, stop or threading.Event(), show)
        counts = {key: getattr(source, key) for key in ("dropped", "incomplete", "lost_packets")}
    if readings.last is None:
        raise CameraError(f"{name} delivers no frame within {seconds:g} s; is it waiting for a trigger?")
    return _report(name, readings, seconds, counts)


def _read(source: Source, seconds: float, stop: threading.Event, show) -> _Readings:
    """The frames of some seconds. A timer closes the source, which may deliver none."""
    readings, begun_s = _Readings(), time.monotonic()
    timer = threading.Timer(seconds, source.close)
    timer.daemon = True
    timer.start()
    try:
        for frame in source:
            readings.add(frame)
            elapsed_s = time.monotonic() - begun_s
            show(min(1.0, elapsed_s / seconds))
            if stop.is_set() or elapsed_s >= seconds:
                break
    finally:
        timer.cancel()
    return readings


def _report(name: str, readings: _Readings, seconds: float, counts: dict[str, int]) -> SourceReport:
    last = readings.last
    assert last is not None
    stamps, arrivals = np.array(readings.stamps) * 1e-6, np.array(readings.arrivals) * 1e-6
    roundels = Detector().detect(last.image)
    blur_px = edge_blur_px(last.image, roundels)
    light = advise(last.image, roundels.uv)
    period_ms, missing, jitter_ms = _regularity(stamps)
    report = SourceReport(
        source=name,
        frames=len(stamps),
        seconds=seconds,
        width=last.image.shape[1],
        height=last.image.shape[0],
        fps=1000 / period_ms if period_ms else None,
        missing=max(0, missing - counts["dropped"] - counts["incomplete"]),
        jitter_ms=jitter_ms,
        delay_ms=float(np.median(arrivals - stamps)),
        out_of_order=int((np.diff(stamps) <= 0).sum()),
        stated_error_ms=max(readings.errors_us) / 1000,
        exposure_us=last.exposure_us,
        readout_us=last.readout_us,
        roundels=len(roundels),
        edge_blur_px=blur_px,
        faults=(),
        **counts,
    )
    return msgspec.structs.replace(report, faults=tuple(_faults(report, light)))


def _regularity(stamps: Array) -> tuple[float | None, int, float | None]:
    """The period, ms, the number of frames that the stamps skip, and the jitter, ms; None for few frames."""
    if len(stamps) < FEW:
        return None, 0, None
    intervals = np.diff(stamps)
    period = float(np.median(intervals))
    if period <= 0:
        return None, 0, None
    periods = np.maximum(1, np.round(intervals / period))
    period = float((stamps[-1] - stamps[0]) / periods.sum())  # without the error of single stamps
    jitter = float(np.quantile(np.abs(intervals - periods * period), 0.95))
    return period, int((periods - 1).sum()), jitter


def _faults(report: SourceReport, light: str) -> list[str]:
    lost = report.missing + report.incomplete
    faults = [
        (report.frames < FEW, f"only {report.frames} frames: is the exposure too long, or a trigger on?"),
        (report.out_of_order > 0, f"{report.out_of_order} stamps are not later than the one before"),
        (
            (report.jitter_ms or 0) > MAX_JITTER_MS,
            f"stamps vary by {report.jitter_ms or 0:.1f} ms: use a camera or a driver with its own time stamps",
        ),
        (
            lost > MAX_MISSING * report.frames,
            f"{lost} frames are lost: a lower rate, another USB controller, or larger packets",
        ),
        (bool(light), light),
        (
            (report.edge_blur_px or 0) >= BLURRED_PX,
            advise_focus(report.edge_blur_px),
        ),
    ]
    return [text for is_fault, text in faults if is_fault]


def _text(report: SourceReport) -> str:
    """Some lines for people."""
    rate = f"{report.fps:.2f} frames/s" if report.fps else "too few frames for a rate"
    jitter = "-" if report.jitter_ms is None else f"{report.jitter_ms:.3f} ms"
    focus = "no roundel in view" if report.edge_blur_px is None else f"{report.edge_blur_px:.2f} px of blur"
    readout = f", rolling shutter of {report.readout_us / 1000:.1f} ms" if report.readout_us else ""
    lines = [
        f"{report.source}: {report.width} x {report.height} pixels, {report.frames} frames, {rate}",
        f"  stamps: jitter {jitter}, {report.delay_ms:.1f} ms before the arrival, bound of their error "
        f"{report.stated_error_ms:.3f} ms, {report.out_of_order} out of order",
        f"  losses: {report.missing} missing, {report.dropped} dropped, {report.incomplete} incomplete, "
        f"{report.lost_packets} packets",
        f"  exposure {report.exposure_us:.0f} us{readout}; focus: {report.roundels} roundels, {focus}",
    ]
    verdict = [f"  FAULT: {fault}" for fault in report.faults] or ["  in order"]
    return "\n".join(lines + verdict)
