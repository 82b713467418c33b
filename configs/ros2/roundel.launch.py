# SPDX-License-Identifier: BSD-3-Clause
"""Launches `roundel ros2` beside other nodes of ROS 2: ros2 launch configs/ros2/roundel.launch.py arena:=lab."""

from launch import LaunchDescription  # pyright: ignore[reportMissingImports]: of ROS
from launch.actions import DeclareLaunchArgument, ExecuteProcess  # pyright: ignore[reportMissingImports]: of ROS
from launch.substitutions import EnvironmentVariable, LaunchConfiguration, PythonExpression  # pyright: ignore[reportMissingImports]: of ROS

DEFAULTS = {
    "connect": ("tcp/localhost:7447", "the arena's server"),
    "arena": ("arena", "the arena's name"),
    "namespace": ("", "prefix of the topics"),
    "frame": ("world", "the name of the world in headers and in tf"),
}


def generate_launch_description() -> LaunchDescription:
    """Over Zenoh if the nodes run with rmw_zenoh_cpp, else over DDS."""
    options = [word for name in DEFAULTS for word in (f"--{name}", LaunchConfiguration(name))]
    middleware = EnvironmentVariable("RMW_IMPLEMENTATION", default_value="")
    dds = PythonExpression(["'--no-dds' if '", middleware, "' == 'rmw_zenoh_cpp' else '--dds'"])
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=text)
        for name, (value, text) in DEFAULTS.items()
    ]
    return LaunchDescription(
        [*declared, ExecuteProcess(cmd=["roundel", "ros2", dds, *options], output="screen")]
    )
