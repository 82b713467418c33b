# SPDX-License-Identifier: BSD-3-Clause
"""The commands about cameras and pictures, one module each."""

import logging

from camera_node.foundation.command_line import Command

COMMANDS = (
    Command(
        "camera",
        "add the cameras of this machine to an arena",
        "camera_node.commands.camera_command:JoinArena",
        (
            "roundel camera",
            "roundel camera --source 0 --connect tcp/server:7447",
            "roundel camera --source recording/north recording/east",
            "roundel camera --source 0 --name scout --rig rig.yaml --diameter 0.09 --listen tcp/127.0.0.1:7447",
        ),
        "Cameras",
    ),
    Command(
        "cameras",
        "list, rename and forget cameras; show what one refuses, and why",
        "camera_node.commands.cameras:cameras",
        (
            "roundel cameras list",
            "roundel cameras rename camera-1 north",
            "roundel cameras why north refused.jpg",
        ),
        "Cameras",
    ),
    Command(
        "settings",
        "show and change exposure, gain and mask of a running camera",
        "camera_node.commands.adjust:ChangeSettings",
        (
            "roundel settings north",
            "roundel settings north --exposure-us 4000 --gain 2",
            "roundel settings north --mask-detected",
        ),
        "Cameras",
        logging.WARNING,
    ),
    Command(
        "snapshot",
        "save the image of a running camera",
        "camera_node.commands.adjust:SaveSnapshot",
        ("roundel snapshot north north.jpg --draw",),
        "Cameras",
        logging.WARNING,
    ),
    Command(
        "detect",
        "detect roundels in pictures",
        "camera_node.commands.detect:Detect",
        ("roundel detect picture.png --draw seen.png", "roundel detect *.png --json"),
        "Pictures",
    ),
    Command(
        "print",
        "print roundels, wands, boards, L-frames and robots at true scale",
        "camera_node.commands.print:Sheet",
        (
            "roundel print roundels",
            "roundel print roundels sheet.svg --diameter 0.12 --paper letter",
            "roundel print wand",
            "roundel print board board.pdf --columns 5 --rows 7 --square 0.035",
            "roundel print robot rover.pdf --file robots.yaml --name rover",
        ),
        "Pictures",
    ),
    Command(
        "simulate",
        "render a simulated recording into a folder",
        "camera_node.simulation.__main__:simulate",
        ("roundel simulate configs/demo/scene.yaml recording --seconds 15",),
        "Pictures",
    ),
)
PUBLISH = Command(
    "publish",
    "publish one camera; roundel camera runs it for each camera of a machine",
    "camera_node.commands.publish:Publish",
)
