"""Parameters of the recorder."""

from __future__ import annotations

from dataclasses import dataclass

from agv_ros.parameters import TwoDomains, parameter


@dataclass(frozen=True)
class RecorderParameters(TwoDomains):
    """Parameters of the node `recorder`."""

    bag: str = parameter("bag", "directory to record to, which must not exist")
    params_file: str = parameter("", "the run's params file, to be embedded in the bag")
    log_time: str = parameter(
        "stamp",
        "log time of a message; stamp: its own, so that equal runs give equal files; receive: when it was received",
        choices=("stamp", "receive"),
    )
    fsync: bool = parameter(False, "have the disk write each chunk, so that a loss of power costs no more than a kill")
    if_unwritable: str = parameter(
        "end",
        "what happens once the disk is full or the bag is gone; end: the recorder ends, and with it the run; continue: "
        "the loop goes on without being recorded",
        choices=("end", "continue"),
    )
