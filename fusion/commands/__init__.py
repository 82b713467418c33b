# SPDX-License-Identifier: BSD-3-Clause
"""The commands of the server, its robots, recordings and bridges, one module each.

A robot's computer has neither GTSAM nor SciPy: its commands import what they need only.
"""

from collections.abc import Iterator

from camera_node.foundation.command_line import Command

SERVER = Command(
    "server",
    "fuse what the cameras publish into poses",
    "fusion.commands.serve:Serve",
    ("roundel server --config arena.yaml", "roundel server --listen tcp/0.0.0.0:7447 --rig rig.yaml"),
    "Arena",
)
# By heading: the module of each command with what has its name, its summary, and examples.
TABLE: dict[str, tuple[tuple[str, ...], ...]] = {
    "Arena": (
        (
            "doctor:doctor",
            "check this machine, the files of an arena and a running server",
            "roundel doctor",
            "roundel doctor --config arena.yaml",
        ),
        (
            "health:health",
            "print the state of a running arena in one line, for people and monitoring systems",
            "roundel health --json",
        ),
    ),
    "Calibration": (
        ("history:history", "list the versions of the running server's rig", "roundel history"),
        ("history:undo", "undo the last change of the running server's rig", "roundel undo"),
        ("history:redo", "redo the change that was undone last", "roundel redo"),
        (
            "verify:Verify",
            "verify a calibration by an object of known size",
            "roundel verify --object rod.yaml --live",
            "roundel verify --object rod.yaml --recording rod.mcap --map rod.png",
        ),
    ),
    "Robots": (
        ("define:define", "measure a new robot in the arena", "roundel define rover --diameter 0.09"),
        (
            "edit_robots:robots",
            "list, rename, remove and save the robots of the running server",
            "roundel robots list",
            "roundel robots rename robot-1 rover",
            "roundel robots save robots.yaml",
        ),
    ),
    "Recordings": (
        ("sample:sample", "write the data of a small arena, to try the commands with", "roundel sample"),
        ("record:record", "record a running arena", "roundel record monday.mcap --seconds 60"),
        (
            "replay:replay",
            "process a recording with the live code",
            "roundel replay monday.mcap --out poses.csv",
        ),
        (
            "run:run",
            "estimate poses from recorded frames or observations",
            "roundel run --frames recording --rig rig.yaml --robots robots.yaml --out poses.csv",
        ),
        (
            "recordings:recordings",
            "list, rename and remove the recordings of a folder",
            "roundel recordings list",
            "roundel recordings rename monday.mcap tuesday",
        ),
        (
            "trim:trim",
            "copy a part of a recording",
            "roundel trim monday.mcap part.mcap --from-s 10 --to-s 20",
        ),
        ("repair:repair", "complete a recording that was cut off", "roundel repair monday.mcap"),
        (
            "export:export",
            "write the poses of a recording for another program",
            "roundel export monday.mcap poses.c3d",
            "roundel export monday.mcap poses.parquet",
        ),
        (
            "plot:plot",
            "draw the trajectories of a recording and their uncertainty",
            "roundel plot monday.mcap",
            "roundel plot monday.mcap --compare tuesday.mcap --out apart.png",
        ),
    ),
    "Bridges": (
        ("bridges.ros2:ros2", "publish the robots to ROS 2", "roundel ros2 --connect tcp/server:7447"),
        ("bridges.vrpn:vrpn", "serve the robots over VRPN", "roundel vrpn --host 0.0.0.0"),
        (
            "bridges.mavlink:mavlink",
            "send a robot's poses to its autopilot",
            "roundel mavlink drone --to udp:192.168.0.7:14550",
        ),
        ("bridges.foxglove:foxglove", "show the arena live in Foxglove", "roundel foxglove"),
    ),
}


def _commands() -> Iterator[Command]:
    for heading, rows in TABLE.items():
        for target, summary, *examples in rows:
            name = target.partition(":")[2].lower()
            yield Command(name, summary, f"fusion.commands.{target}", tuple(examples), heading)


COMMANDS = (SERVER, *_commands())
