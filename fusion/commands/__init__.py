# SPDX-License-Identifier: BSD-3-Clause
"""The commands of the server, its robots, recordings and bridges, one module each.

A robot's computer has neither GTSAM nor SciPy: its commands import what they need only.
"""

from camera_node.foundation.command_line import Command


def _command(group: str, name: str, summary: str, target: str, *examples: str) -> Command:
    return Command(name, summary, f"fusion.commands.{target}", examples, group)


SERVER = _command(
    "Arena",
    "server",
    "fuse what the cameras publish into poses",
    "serve:Serve",
    "roundel server --config arena.yaml",
    "roundel server --listen tcp/0.0.0.0:7447 --rig rig.yaml",
)
COMMANDS = (
    SERVER,
    _command(
        "Arena",
        "doctor",
        "check this machine, the files of an arena and a running server",
        "doctor:doctor",
        "roundel doctor",
        "roundel doctor --config arena.yaml",
    ),
    _command(
        "Arena",
        "health",
        "print the state of a running arena in one line, for people and monitoring systems",
        "health:health",
        "roundel health --json",
    ),
    _command(
        "Calibration",
        "history",
        "list the versions of the running server's rig",
        "history:history",
        "roundel history",
    ),
    _command(
        "Calibration",
        "undo",
        "undo the last change of the running server's rig",
        "history:undo",
        "roundel undo",
    ),
    _command(
        "Calibration",
        "redo",
        "redo the change that was undone last",
        "history:redo",
        "roundel redo",
    ),
    _command(
        "Calibration",
        "verify",
        "verify a calibration by an object of known size",
        "verify:Verify",
        "roundel verify --object rod.yaml --live",
        "roundel verify --object rod.yaml --recording rod.mcap --map rod.png",
    ),
    _command(
        "Robots",
        "define",
        "measure a new robot in the arena",
        "define:define",
        "roundel define rover --diameter 0.09",
    ),
    _command(
        "Robots",
        "robots",
        "list, rename, remove and save the robots of the running server",
        "edit_robots:robots",
        "roundel robots list",
        "roundel robots rename robot-1 rover",
        "roundel robots save robots.yaml",
    ),
    _command(
        "Recordings",
        "sample",
        "write the data of a small arena, to try the commands with",
        "sample:sample",
        "roundel sample",
    ),
    _command(
        "Recordings",
        "record",
        "record a running arena",
        "record:record",
        "roundel record monday.mcap --seconds 60",
    ),
    _command(
        "Recordings",
        "replay",
        "process a recording with the live code",
        "replay:replay",
        "roundel replay monday.mcap --out poses.csv",
    ),
    _command(
        "Recordings",
        "run",
        "estimate poses from recorded frames or observations",
        "run:run",
        "roundel run --frames recording --rig rig.yaml --robots robots.yaml --out poses.csv",
    ),
    _command(
        "Recordings",
        "recordings",
        "list, rename and remove the recordings of a folder",
        "recordings:recordings",
        "roundel recordings list",
        "roundel recordings rename monday.mcap tuesday",
    ),
    _command(
        "Recordings",
        "trim",
        "copy a part of a recording",
        "trim:trim",
        "roundel trim monday.mcap part.mcap --from-s 10 --to-s 20",
    ),
    _command(
        "Recordings",
        "repair",
        "complete a recording that was cut off",
        "repair:repair",
        "roundel repair monday.mcap",
    ),
    _command(
        "Recordings",
        "export",
        "write the poses of a recording for another program",
        "export:export",
        "roundel export monday.mcap poses.c3d",
        "roundel export monday.mcap poses.parquet",
    ),
    _command(
        "Recordings",
        "plot",
        "draw the trajectories of a recording and their uncertainty",
        "plot:plot",
        "roundel plot monday.mcap",
        "roundel plot monday.mcap --compare tuesday.mcap --out apart.png",
    ),
    _command(
        "Bridges",
        "ros2",
        "publish the robots to ROS 2",
        "bridges.ros2:ros2",
        "roundel ros2 --connect tcp/server:7447",
    ),
    _command(
        "Bridges",
        "vrpn",
        "serve the robots over VRPN",
        "bridges.vrpn:vrpn",
        "roundel vrpn --host 0.0.0.0",
    ),
    _command(
        "Bridges",
        "mavlink",
        "send a robot's poses to its autopilot",
        "bridges.mavlink:mavlink",
        "roundel mavlink drone --to udp:192.168.0.7:14550",
    ),
    _command(
        "Bridges",
        "foxglove",
        "show the arena live in Foxglove",
        "bridges.foxglove:foxglove",
        "roundel foxglove",
    ),
)
