# SPDX-License-Identifier: BSD-3-Clause
"""Creates the frames, the wand's recording and the lenses of configs/sample: `.venv/bin/python docs/sample_data.py`.

`recording.mcap` is eight seconds of `roundel demo`, recorded by `roundel record`; `rig.yaml` and `robots.yaml` are its
own. The frames show the same arena.
"""

import shutil
import tempfile
from pathlib import Path

import cv2

from calib.rig.recording import RecordingWriter
from camera_node.protocol.messages import Keys, encode
from roundel import Recording, simulate

ROOT = Path(__file__).resolve().parents[1]
DEMO, SAMPLE = ROOT / "configs" / "demo", ROOT / "configs" / "sample"
WAND_S, FRAMES_S = 15.0, 0.5
QUALITY = 92  # of a JPEG: the sample stays below 5 MB


def main() -> None:
    """Render, detect and write."""
    scene = DEMO / "scene.yaml"
    recording = Recording(SAMPLE / "recording.mcap")
    assert recording.rig is not None
    assert recording.robots is not None
    for old in SAMPLE.glob("rig*.yaml"):
        old.unlink()
    recording.rig.save(SAMPLE / "rig.yaml")
    recording.robots.save(SAMPLE / "robots.yaml")
    shutil.copy(DEMO / "wand.yaml", SAMPLE / "wand.yaml")
    with tempfile.TemporaryDirectory() as folder:
        wand = simulate(scene, Path(folder) / "wand", WAND_S)
        with RecordingWriter(SAMPLE / "wand.mcap") as writer:
            for received_ns, message in wand.arrivals():
                writer.put(Keys("demo").detections(message.camera), encode(message), received_ns)
        shutil.copy(Path(folder) / "wand" / "rig.yaml", SAMPLE / "lenses.yaml")
        simulate(scene, Path(folder) / "robots", FRAMES_S, start_s=WAND_S)
        shutil.rmtree(SAMPLE / "frames", ignore_errors=True)
        for png in sorted((Path(folder) / "robots").glob("*/*.png")):
            jpeg = SAMPLE / "frames" / png.parent.name / f"{png.stem}.jpg"
            jpeg.parent.mkdir(parents=True, exist_ok=True)
            image = cv2.imread(str(png), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            cv2.imwrite(str(jpeg), image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    total = sum(path.stat().st_size for path in SAMPLE.rglob("*") if path.is_file())
    print(f"{SAMPLE}: {total / 1e6:.2f} MB")


if __name__ == "__main__":
    main()
