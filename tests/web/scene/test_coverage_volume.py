# SPDX-License-Identifier: BSD-3-Clause
"""The points that show what the cameras see, in a real Viser server."""

import numpy as np
import viser

from calib.rig.camera import Camera
from calib.rig.rig import Rig
from camera_node.geometry.pose import Pose, look_at
from tests.waiting import wait_for
from web.scene.coverage_volume import MANY, SINGLE, CoverageVolume, colours, covered_points
from web.state.feed import ArenaState

LENS = {"width": 1280, "height": 800, "fx": 900.0, "fy": 900.0, "cx": 639.5, "cy": 399.5}


def rig_of(*positions: tuple[float, float, float]) -> Rig:
    poses = [Pose.from_matrix(look_at(position, (0.0, 0.0, 0.5))) for position in positions]
    return Rig(cameras={f"c{k}": Camera(**LENS, T_world_cam=pose) for k, pose in enumerate(poses)})


RING = rig_of((2.0, 0.0, 2.5), (-2.0, 0.0, 2.5), (0.0, 2.0, 2.5))


def test_points_are_those_in_the_images_of_as_many_cameras():
    """A camera that detects the roundel has its centre in the image; no shown point is seen by no camera."""
    points, count = covered_points(RING)
    inside = sum(camera.sees(camera.project_world(points)).astype(int) for camera in RING.placed().values())
    assert len(points) > 100
    assert set(np.unique(count)) == {1, 2, 3}
    assert (count <= inside).all()
    assert (colours(np.array([1, 3, 7])) == [SINGLE, MANY, MANY]).all()


def test_a_rig_without_poses_has_no_points():
    points, count = covered_points(Rig(cameras={"c0": Camera(**LENS)}))
    assert (points.shape, count.shape) == ((0, 3), (0,))


def test_the_check_box_shows_and_hides_the_points(server: viser.ViserServer):
    faults: list[str] = []
    volume, state = CoverageVolume(server, faults.append), ArenaState(rig=RING)
    volume.update(state)
    assert not volume.cloud.visible
    volume.box.value = True
    wait_for(lambda: volume.cloud.visible, lambda: volume.update(state))
    assert len(volume.cloud.points) == len(covered_points(RING)[0])
    volume.box.value = False
    volume.update(state)
    assert not volume.cloud.visible
    assert faults == []


def test_a_rig_that_is_too_large_is_counted(server: viser.ViserServer):
    faults: list[str] = []
    volume = CoverageVolume(server, faults.append)
    volume.box.value = True
    far = ArenaState(rig=rig_of((2.0, 0.0, 2.5), (9e4, 0.0, 2.5)))
    wait_for(lambda: faults, lambda: volume.update(far))
    assert not volume.cloud.visible
