# SPDX-License-Identifier: BSD-3-Clause
"""Recordings of the simulations in the layouts of other programs, as these write them."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from calib.commands.formats import FORMATS, FormatName
from calib.rig.rig import Rig
from camera_node.geometry.body import Body
from camera_node.protocol.messages import Detections

# Writes to a folder, and returns what to import.
Layout = Callable[[Path, Rig, Body, Sequence[Detections]], tuple[Path, ...]]


def write_caliscope(folder: Path, rig: Rig, wand: Body, messages: Sequence[Detections]) -> tuple[Path, ...]:
    """Write a session of Caliscope 0.11: cameras, the points of one object with their places on it, and times by each
    camera's own clock."""
    FORMATS["caliscope"].write(rig, folder, FORMATS["caliscope"].origin)
    numbers = {name: k for k, name in enumerate(rig.cameras)}
    rows = ["sync_index,cam_id,object_id,keypoint_id,img_loc_x,img_loc_y,obj_loc_x,obj_loc_y,obj_loc_z"]
    times = ["sync_index,cam_id,frame_index,frame_time"]
    places = [",".join(f"{x:.9g}" for x in place) for place in wand.points]
    for message in messages:
        frame = f"{message.seq},{numbers[message.camera]}"
        times.append(f"{frame},{message.seq},{1e-9 * message.t_ns:.6f}")
        seen = message.unpack()
        rows += [
            f"{frame},0,{k},{u:.6f},{v:.6f},{places[k]}"
            for k, (u, v) in zip(np.maximum(seen.id, 0).tolist(), seen.uv.tolist(), strict=True)
        ]
    (folder / "xy_CHARUCO.csv").write_text("\n".join(rows) + "\n")
    (folder / "timestamps.csv").write_text("\n".join(times) + "\n")
    return (folder,)


def write_clicks(name: FormatName) -> Layout:
    """Return the writer of `profile.txt` and `xypts.csv` of a program in which people click points, one row a frame of
    synchronous cameras, NaN where a point is not seen."""
    chosen = FORMATS[name]

    def write(folder: Path, rig: Rig, wand: Body, messages: Sequence[Detections]) -> tuple[Path, ...]:
        cameras, points = list(rig.cameras), len(wand.points)
        table = np.full((1 + max(m.seq for m in messages), points, len(cameras), 2), np.nan)
        for message in messages:
            seen, number = message.unpack(), cameras.index(message.camera)
            table[message.seq, seen.id, number] = chosen.origin.write(seen.uv, message.height)
        header = [
            f"pt{m + 1}_cam{c + 1}_{x}" for m in range(points) for c in range(len(cameras)) for x in "XY"
        ]
        rows = table.reshape(len(table), -1)
        np.savetxt(folder / "xypts.csv", rows, delimiter=",", header=",".join(header), comments="")
        chosen.write(rig, folder, chosen.origin)
        return folder / "profile.txt", folder / "xypts.csv"

    return write


LAYOUTS: dict[FormatName, Layout] = {
    "caliscope": write_caliscope,
    "argus": write_clicks("argus"),
    "dltdv": write_clicks("dltdv"),
}
