# SPDX-License-Identifier: BSD-3-Clause
"""Makes tests/data/wand: renders the demo's wand, detects the roundels, and writes observations and truth.

Run as `python -m tests.data.make_wand` in the repository's root; it takes a minute or two.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from calib.rig.rig import Rig, load_rig, save_rig
from camera_node.geometry.pose import Pose, invert
from camera_node.simulation.scene import Scene
from camera_node.simulation.simulated_camera import render_recording
from camera_node.sources.recorded_detections import detect_frames

SECONDS = 6.0
FOLDER = Path(__file__).resolve().parent / "wand"
SCENE = FOLDER.parents[2] / "configs" / "demo" / "scene.yaml"


def main() -> None:
    """Write observations.csv, rig.yaml (intrinsics) and truth.yaml (the same with poses)."""
    scene = Scene.load(SCENE)
    with TemporaryDirectory() as name:
        frames = Path(name)
        render_recording(scene, frames, 0.0, SECONDS)
        rig, messages = load_rig(frames / "rig.yaml"), detect_frames(frames)
        truth = msgspec.json.decode((frames / "truth.json").read_bytes())["cameras"]
    rows = ["t_ns,camera,u,v"]
    for message in messages:
        rows += [f"{message.t_ns},{message.camera},{u:.3f},{v:.3f}" for u, v in message.unpack().uv]
    (FOLDER / "observations.csv").write_text("\n".join(rows) + "\n")
    poses = {
        camera: Pose.from_matrix(invert(np.array(entry["T_cam_world"]))) for camera, entry in truth.items()
    }
    cameras = {n: msgspec.structs.replace(c, T_world_cam=poses[n]) for n, c in rig.cameras.items()}
    for file, content in (("rig.yaml", rig), ("truth.yaml", Rig(cameras=cameras))):
        (FOLDER / file).unlink(missing_ok=True)  # save_rig would keep the previous file
        save_rig(content, FOLDER / file)


if __name__ == "__main__":
    main()
