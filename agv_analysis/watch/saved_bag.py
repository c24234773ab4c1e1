"""What was heard of a loop as a bag."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

from agv_analysis.bags.message_definitions import schema_of
from agv_analysis.bags.rosbag2_metadata import TopicInfo
from agv_analysis.bags.writer import NODES_NAME, BagWriter
from agv_analysis.scenario import Scenario, metadata_of
from agv_analysis.watch.live_loop import DIAGNOSTICS, TOPICS
from agv_analysis.watch.message_log import MessageLog
from agv_ros.codec import stamp_of

_OF_EVERY_STEP = ("edge/slot", "agv/pose", "edge/error", "edge/cmd_vel")


def save_bag(
    directory: Path, log: MessageLog, names: Sequence[str], types: Sequence[str], scenario: Scenario,
    nodes: Mapping[str, str],
) -> int:  # fmt: skip
    """Write the messages of a log to a new directory; returns how many.

    `names` and `types` are those of the topics by number, `scenario` what the loop began with, `nodes` the full names
    of its nodes. Raises UserError if the directory exists or cannot be made, OSError if it cannot be written to.
    """
    known = [TopicInfo(name, kind, schema_of(kind), "", []) for name, kind in zip(names, types, strict=True)]
    about = metadata_of(scenario)
    by_stamp = scenario.plant.clock == "lockstep"
    writer = BagWriter(directory, [partial(known.__getitem__, i) for i in range(len(known))], about, by_stamp)
    try:
        first_ns, last_ns = _of_all_topics(log)
        for topic, data, received_ns in log.messages():
            stamp_ns = max(0, stamp_of(data))
            if topic != DIAGNOSTICS and not first_ns <= stamp_ns <= last_ns:
                continue
            writer.write(topic, data, stamp_ns if by_stamp else received_ns, stamp_ns)
        writer.add_metadata(NODES_NAME, {"params": about["params"], **nodes})
        writer.close()
    except OSError:
        writer.abandon()
        raise
    return sum(writer.counts)


def _of_all_topics(log: MessageLog) -> tuple[int, int]:
    """From which stamp [ns] to which one each topic that has a message of every step is heard.

    Before and after it some topics lack what others have, only since they were connected or taken from one by one.
    """
    heard: dict[int, list[int]] = {}
    for topic, data, _ in log.messages():
        if TOPICS[topic] in _OF_EVERY_STEP:
            heard.setdefault(topic, []).append(stamp_of(data))
    if not heard:
        return 0, 2**63 - 1
    return max(map(min, heard.values())), min(map(max, heard.values()))
