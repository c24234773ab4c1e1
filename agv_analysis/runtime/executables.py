"""The nodes as programs: which module each is, and the executables that `ros2 run` finds."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path

NODE_MODULES = {
    "plant": "agv_plant.plant_node",
    "relay": "agv_plant.relay_node",
    "error_detector": "agv_cloud.error_detector_node",
    "controller": "agv_cloud.controller_node",
    "recorder": "agv_analysis.runtime.recorder_node",
    "link_emulator": "agv_plant.link_emulator_node",
}
"""The module of each node; each has a `main` that takes its arguments."""

_FOLDER_OF_ROS = "agv_ncs"
"""In a workspace the executables lie in lib/agv_ncs, where `ros2 run` looks for them."""


def run_node_of(name: str, arguments: Sequence[str] | None = None) -> None:
    """Run a node until it ends; without arguments those of this process. Help is printed, and nothing is run.

    Raises ImportError where there is no ROS.
    """
    words = sys.argv[1:] if arguments is None else list(arguments)
    if {"--help", "-h"} & set(words):
        sys.stdout.write(importlib.import_module("agv_analysis.runtime.node_help").help_text(name) + "\n")
        return
    importlib.import_module(NODE_MODULES[name]).main(arguments)


def _executable(name: str) -> None:
    """A node by its old name, which pip also puts among the commands of everyone; that ends with the next release."""
    if Path(sys.argv[0]).parent.name != _FOLDER_OF_ROS:
        instead = f"`agv-ncs node {name}`, or `ros2 run agv_ncs {name}`"
        sys.stderr.write(f"note: the command `{name}` goes with the next release: use {instead}\n")
    run_node_of(name)


def plant() -> None:
    """Entry point of the executable `plant`."""
    _executable("plant")


def relay() -> None:
    """Entry point of the executable `relay`."""
    _executable("relay")


def error_detector() -> None:
    """Entry point of the executable `error_detector`."""
    _executable("error_detector")


def controller() -> None:
    """Entry point of the executable `controller`."""
    _executable("controller")


def recorder() -> None:
    """Entry point of the executable `recorder`."""
    _executable("recorder")


def link_emulator() -> None:
    """Entry point of the executable `link_emulator`."""
    _executable("link_emulator")
