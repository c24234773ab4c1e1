"""The pose of a robot from /tf: where one frame is in another, through the frames between them.

The transform that moves the robot's own frame gives the instants; of those further up, as map to odom, the newest one
counts, as tf2 has it for what is published seldom. Poses are those in the plane: roll, pitch and height are left out.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from agv_analysis.bags import Bag
from agv_analysis.bags.layout import LOG_TIME
from agv_analysis.recordings.messages_on_steps import Steps, stamps_of
from agv_analysis.recordings.posture_track import Track, in_order, messages_of, with_speeds, yaws_of
from agv_analysis.run import Floats
from agv_ros.counted import counted
from agv_ros.errors import UserError

TRANSFORMS = "tf2_msgs/msg/TFMessage"
STATIC = "/tf_static"


class _Link(NamedTuple):
    """Where a frame is in its parent over time; arrays of shape (M,), by stamps [ns]."""

    stamps: Steps
    log_times: Steps
    x: Floats
    y: Floats
    theta: Floats


def read_transforms(bag: Bag, topic: str, parent: str, child: str) -> Track:
    """Postures of the frame `child` in the frame `parent`, by the transforms of a topic and of /tf_static.

    Raises UserError if the frames are not joined.
    """
    links = _links(messages_of(bag, topic, (TRANSFORMS,), "pose"))
    static = _links(bag[STATIC]) if STATIC in bag.topics and len(bag[STATIC]) else {}
    chain = _chain({**static, **links}, parent, child, f"{bag.path}: {topic}")
    moving = next((key for key in chain if key in links), None)
    if moving is None:
        raise UserError(f"{bag.path}: {topic}: nothing between {parent} and {child} moves")
    stamps, log_times = links[moving].stamps, links[moving].log_times
    known = np.ones(len(stamps), dtype=np.bool_)
    x, y, theta = np.zeros(len(stamps)), np.zeros(len(stamps)), np.zeros(len(stamps))
    for key in chain:  # from the child up
        link = links.get(key) or static[key]
        newest = np.searchsorted(link.stamps, stamps, side="right") - 1 if key in links else np.zeros(len(stamps), int)
        known &= newest >= 0
        row = np.maximum(newest, 0)
        cos, sin = np.cos(link.theta[row]), np.sin(link.theta[row])
        x, y = link.x[row] + cos * x - sin * y, link.y[row] + sin * x + cos * y
        theta = theta + link.theta[row]
    still = np.zeros(len(stamps))
    track = Track(stamps, log_times, x, y, theta, still, still, parent).chosen(known)
    if not len(track.stamps):
        raise UserError(f"{bag.path}: {topic}: no instant at which all transforms from {parent} to {child} are known")
    ordered = in_order(track, f"{bag.path}: {topic}", topic)
    early = int(np.count_nonzero(~known))
    note = f"{topic}: {counted(early, 'transform')} came before all of those from {parent} to {child} were known"
    return with_speeds(ordered)._replace(notes=(*ordered.notes, note) if early else ordered.notes)


def _links(messages: NDArray[np.void]) -> dict[tuple[str, str], _Link]:
    """All transforms, by parent and child, in the order of their stamps."""
    sent = messages["transforms.transform.translation.x"].shape[1]
    own = np.arange(sent) < messages["len(transforms)"][:, np.newaxis]
    stamps = stamps_of(messages, "transforms.header.stamp")[own]
    theta = yaws_of(messages, "transforms.transform", "rotation")[own]
    logged = np.repeat(messages[LOG_TIME].astype(np.int64), np.count_nonzero(own, axis=1))
    x, y = (messages[f"transforms.transform.translation.{axis}"][own] for axis in "xy")
    names = [
        [name.decode("utf-8", "replace").lstrip("/") for name in messages[field][own].tolist()]
        for field in ("transforms.header.frame_id", "transforms.child_frame_id")
    ]
    keys = np.array([f"{parent}\n{child}" for parent, child in zip(*names, strict=True)])
    found = {}
    for key in np.unique(keys).tolist():
        rows = np.flatnonzero(keys == key)
        rows = rows[np.argsort(stamps[rows], kind="stable")]
        parent, _, child = key.partition("\n")
        found[parent, child] = _Link(stamps[rows], logged[rows], x[rows], y[rows], theta[rows])
    return found


def _chain(links: dict[tuple[str, str], _Link], parent: str, child: str, where: str) -> list[tuple[str, str]]:
    """The transforms from a frame up to another. Raises UserError if it has no such parent, or two."""
    chain: list[tuple[str, str]] = []
    frame, wanted = child.lstrip("/"), parent.lstrip("/")
    while frame != wanted:
        above = [key for key in links if key[1] == frame and key not in chain]
        if len(above) != 1:
            known = ", ".join(f"{one} to {other}" for one, other in sorted(links))
            why = "has several parents" if above else "has no parent"
            raise UserError(f"{where}: {frame} {why} on the way up to {wanted}; there are {known}")
        chain += above
        frame = above[0][0]
    return chain
