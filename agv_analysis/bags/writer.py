"""Writing a rosbag2 directory: metadata.yaml and one MCAP file, as `ros2 bag` knows them, from serialised messages.

Messages are put in the order (log time, topic, payload) before they are written, within a window that is far longer
than the loop needs to carry a step around. One that comes later still, as DDS may take seconds to bring a message again
that a busy recorder has missed, is written as it comes, and the file is put in order when it is closed. In lockstep,
where log times are stamps, two equal runs thus give equal files, whatever way their messages overtook each other.

What is in the window, and in a chunk that is not full, is lost if the recorder is killed: less than a thousand steps of
a loop in lockstep, or what came since the last call but one of `write_older`.
"""

from __future__ import annotations

import contextlib
import heapq
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from agv_analysis.bags.rosbag2_metadata import TopicInfo, metadata_text, rosbag2_metadata
from agv_ros.errors import UserError

if TYPE_CHECKING:
    from agv_analysis.bags.mcap_output import McapOutput, Recorded

METADATA_NAME = "agv_ncs"
"""Name of the MCAP metadata record that holds the run's version, seed and parameters."""

REPLAY_OF = "replay_of"
"""Key in it that names the recording, if the edge answered to that instead of an AGV."""

NODES_NAME = "agv_ncs_nodes"
"""Name of the record with what the loop's nodes said: the full name of each, and `params`, their parameters' values."""

RESTART = "restart_"
"""Of the i-th node that was started again `restart_i_from` is the stamp [ns] from which on it is another process, and
`restart_i_params` what that said of its parameters, as a params file."""

_WINDOW = 3072
"""Messages that are held back to be ordered where log times are stamps."""

_BATCH = 1024
"""Messages that are written at a time, likewise."""

_SMALL_BATCH = 256
"""Likewise, where log times are those of receiving: few, since a loop in real time in this process waits meanwhile."""

_FIRST = 1024
"""Messages after which topics are described, while those who offer them are still there."""

_MOST_LATE = 100_000
"""So many messages are kept to be put in order when the file is closed; with more, it stays as it is."""


@contextmanager
def new_directory(directory: Path) -> Iterator[None]:
    """Make a directory for recordings, and what is in it first. Raises UserError if it exists or cannot be made."""
    try:
        directory.mkdir(parents=True)
        yield
    except FileExistsError:
        raise UserError(f"{directory}: exists already; name a new directory or remove it first") from None
    except OSError as error:
        raise UserError(f"{directory}: cannot be recorded to: {error.strerror}") from None


def _output() -> type[McapOutput]:
    """What writes the file. Raises UserError if the library for it is not installed."""
    try:
        from agv_analysis.bags.mcap_output import McapOutput
    except ModuleNotFoundError:
        raise UserError(
            "writing a bag needs mcap, which is not installed: pip install 'agv_ncs[bags]'; "
            "without it, record with `ros2 bag record -s mcap`"
        ) from None
    return McapOutput


class BagWriter:
    """An open bag. `describe` is asked for a topic, by its number, once there are some messages, or at the end.

    A topic without a publisher is in the bag only once it has a message. All but the constructor raise OSError once the
    bag cannot be written to any more; what is in it by then can be read.
    """

    def __init__(
        self, directory: Path, describe: Sequence[Callable[[], TopicInfo]], about: dict[str, str], by_stamp: bool,
        sync: bool = False,
    ) -> None:  # fmt: skip
        """Create the directory. `by_stamp`: log times are stamps. `sync`: have the disk write what was written.

        Raises UserError if it exists or cannot be made.
        """
        self._window, self._batch = (_WINDOW, _BATCH) if by_stamp else (0, _SMALL_BATCH)
        self._room = _FIRST if by_stamp else _SMALL_BATCH
        self._directory = directory
        self._file_name = f"{directory.name}_0.mcap"
        self._describe = describe
        self._about = METADATA_NAME, about
        self._said: list[tuple[str, dict[str, str]]] = []
        self._first: list[int] = []
        """Numbers of the topics that had publishers when they were described."""
        self._pending: list[Recorded] = []
        self._young = 0
        """Messages since the last call of `write_older`."""
        self._newest: Recorded | None = None
        self._late: list[Recorded] = []
        self.counts = [0] * len(describe)
        self._first_ns, self._last_ns = 2**63, 0
        output = _output()  # before there is a directory
        with new_directory(directory):
            self._file = output(directory / self._file_name, describe, self._about, sync)

    def write(self, topic: int, data: bytes, log_time_ns: int, publish_time_ns: int) -> None:
        """Add a message to the topic with this number."""
        self._pending.append((log_time_ns, topic, data, publish_time_ns))
        self.counts[topic] += 1
        self._young += 1
        if len(self._pending) >= self._room:
            self._write_all_but(self._window)
            self._file.check()
            self._room = self._window + self._batch

    def write_older(self) -> None:
        """Give the system all messages that were here at the last call already; for a loop in real time."""
        if self._pending or self._young:
            self._write_all_but(min(self._young, len(self._pending)))
        self._young = 0
        self._file.finish_chunk()

    def add_metadata(self, name: str, content: dict[str, str]) -> None:
        """Add a metadata record, behind the messages."""
        self._said.append((name, content))

    def close(self) -> None:
        """Write what is held back, the index and metadata.yaml; put the file in order if some messages came late."""
        try:
            self._write_all_but(0)
        except OSError:
            self._file.abandon()
            raise
        topics = [(topic, self.counts[number]) for number, topic in sorted(self._file.topics.items())]
        metadata = rosbag2_metadata(self._file_name, min(self._first_ns, self._last_ns), self._last_ns, topics)
        self._said.append(("rosbag2", {"serialized_metadata": metadata_text(metadata)}))
        self._file.finish(self._said)
        if 0 < len(self._late) <= _MOST_LATE:
            self._put_in_order()
        unfinished = self._directory / "metadata.yaml.part"
        unfinished.write_text(metadata_text({"rosbag2_bagfile_information": metadata}), encoding="utf-8")
        unfinished.replace(self._directory / "metadata.yaml")

    def abandon(self) -> None:
        """Close the file as it is, after an OSError."""
        self._file.abandon()

    def _write_all_but(self, newest: int) -> None:
        if not self._file.topics:
            for number, describe in enumerate(self._describe):
                topic = describe()
                if topic.offered_qos or self.counts[number]:
                    self._file.register(number, topic)
                    self._first.append(number)
        count = len(self._pending) - newest
        if count <= 0:
            return
        self._pending.sort()
        ready = self._pending[:count]
        late = 0 if self._newest is None else bisect_left(ready, self._newest)
        if late and len(self._late) <= _MOST_LATE:
            self._late += ready[:late]
        if late < count:
            self._newest = ready[-1]
        self._file.write(ready)
        self._first_ns = min(self._first_ns, ready[0][0])
        self._last_ns = max(self._last_ns, ready[-1][0])
        del self._pending[:count]

    def _put_in_order(self) -> None:
        """Write the file anew, with the messages that came late in their places; without room for that leave it."""
        path = self._directory / f"{self._file_name}.part"
        with contextlib.suppress(OSError):
            known = [partial(self._file.topics.__getitem__, number) for number in range(len(self.counts))]
            file = _output()(path, known, self._about, sync=False)
            try:
                for number in self._first:
                    file.register(number, self._file.topics[number])
                file.write(heapq.merge(self._in_order(), sorted(self._late)))
                file.finish(self._said)
                path.replace(self._file.path)
            except OSError:
                file.abandon()
                path.unlink(missing_ok=True)

    def _in_order(self) -> Iterator[Recorded]:
        """The messages of the file that did not come late."""
        newest: Recorded | None = None
        for message in self._file.messages():
            if newest is None or message >= newest:
                newest = message
                yield message
