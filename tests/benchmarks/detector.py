# SPDX-License-Identifier: BSD-3-Clause
"""What a frame costs to search: `python -m tests.benchmarks.detector`, times of one thread in the same run.

Each row also as a ratio: to reading the pixels once, and to OpenCV's threshold, findContours and fitEllipse.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.detector import Detector

SIZES = ((640, 480), (1280, 720), (1920, 1080))
COUNTS = (0, 1, 10, 50)
SECONDS = 0.3  # of repetitions a figure
Grey = NDArray[np.uint8]


def clutter(width: int, height: int, count: int, rng: np.random.Generator) -> Grey:
    """Smooth clutter with noise, and `count` cards on a grid, 18 to 44 px wide at 640 px and scaled with the width."""
    rough = rng.normal(110, 35, (height // 16, width // 16)).astype(np.float32)
    image = cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC)
    columns = int(np.ceil(np.sqrt(max(count, 1) * width / height)))
    step = width / columns
    for k in range(count):
        centre = (
            step * (k % columns + 0.5),
            min(step, height / np.ceil(count / columns)) * (k // columns + 0.5),
        )
        radius = rng.uniform(9, 22) * width / 640 * min(1.0, step * 640 / width / 60)
        for scale, level in ((9 / 7, 230), (1.0, 30), (0.6, 230)):
            place = (round(16 * centre[0]), round(16 * centre[1]))
            cv2.circle(image, place, round(16 * scale * radius), level, -1, cv2.LINE_AA, 4)
    image = cv2.GaussianBlur(image, (0, 0), 0.7) + rng.normal(0, 3, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8)


def contours(image: Grey) -> None:
    """What people write first: a global threshold, its contours, and an ellipse for each."""
    _, mask = cv2.threshold(image, 0, 255, cv2.THRESH_BINARY | cv2.THRESH_OTSU)
    found, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    for contour in found:
        if len(contour) >= 20:
            cv2.fitEllipse(contour)


def milliseconds(work: Callable[[], object]) -> float:
    """Median time of one call, after a warm-up."""
    work()
    times, end = [], time.perf_counter() + SECONDS
    while time.perf_counter() < end or len(times) < 5:
        start = time.thread_time()
        work()
        times.append(time.thread_time() - start)
    return 1e3 * float(np.median(times))


def main() -> None:
    cv2.setNumThreads(1)
    rng = np.random.default_rng(1)
    print(f"{'size':>10} {'there':>6} {'found':>6} {'ms':>8} {'x read':>8} {'x OpenCV':>9}")
    for width, height in SIZES:
        for count in COUNTS:
            image = clutter(width, height, count, rng)
            detector = Detector()
            found = len(detector.detect(image))
            ours = milliseconds(lambda d=detector, i=image: d.detect(i))
            read = milliseconds(lambda i=image: int(i.max()))
            theirs = milliseconds(lambda i=image: contours(i))
            ratios = f"{ours / read:8.0f} {ours / theirs:9.2f}"
            print(f"{width:>5}x{height:<4} {count:>6} {found:>6} {ours:8.2f} {ratios}", flush=True)


if __name__ == "__main__":
    main()
