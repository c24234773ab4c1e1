"""Directories in disorder: every message that is there is read, and every disagreement is said."""

from __future__ import annotations

import bz2
import contextlib
import gzip
import json
import lzma
import os
import sqlite3
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
import zstandard

from agv_analysis.bags import BagError, read_bag
from agv_ros.printable import printable

Payloads = dict[str, list[tuple[int, bytes]]]
Odd = Callable[[str], Path]


def test_every_message_that_other_readers_find_is_found(any_bag: Path, by_others: Callable[[Path], Payloads]) -> None:
    bag = read_bag(any_bag)
    found = {topic: sorted(bag.payloads(topic)) for topic in bag.topics}
    assert found == {topic: sorted(data for _, data in messages) for topic, messages in by_others(any_bag).items()}
    assert {topic: bag.topics[topic].count for topic in found} == {topic: len(data) for topic, data in found.items()}
    if "/point" in bag.arrays and bag.topics["/point"].type == "geometry_msgs/msg/Point" and len(bag["/point"]):
        assert sorted(bag["/point"]["x"].tolist()) == [float(i) for i in range(7)]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("renamed topic in metadata.yaml", "/point: topic that metadata.yaml calls /position: 1"),
        ("renamed data file", "bag_0.db3 named by metadata.yaml but missing, monday.db3 read in place of it: 1"),
        ("renamed split", "x_1.db3 named by metadata.yaml but missing, y_1.db3 read in place of it: 1"),
        ("compressed by hand", "x_1.db3.zstd named by metadata.yaml, x_1.db3.zst read in its place: 1"),
        ("path of a file of a split", "x_1.db3.zstd is one of 2 files of a split bag, all of them read: 1"),
        ("compressed splits without metadata.yaml", "split bag that begins with number 9, the files before it not "
         "here: 1"),
        ("compressed splits without metadata.yaml", "directory without metadata.yaml, all of its files read in the "
         "order of their numbers: 1"),
    ],
)  # fmt: skip
def test_disorder_is_said_and_no_loss(odd_bag: Odd, name: str, said: str) -> None:
    bag = read_bag(odd_bag(name))
    assert said in bag.problems
    assert bag.is_complete


@pytest.mark.parametrize("name", ["other QoS in metadata.yaml", "no storage identifier", "path of metadata.yaml"])
def test_what_changes_nothing_is_not_said(odd_bag: Odd, name: str) -> None:
    bag = read_bag(odd_bag(name))
    assert not any("metadata.yaml" in problem for problem in bag.problems)
    assert bag.is_complete
    assert bag.topics["/point"].offered_qos == "- depth: 1"


def test_several_renamed_topics_that_look_alike_are_no_loss(
    tmp_path: Path, make_database: Callable[..., Path], make_metadata: Callable[..., str]
) -> None:
    rows = [(topic, "geometry_msgs/msg/Point", 1 + i, b"\0\1\0\0" + bytes(24)) for topic in "ab" for i in range(3)]
    (tmp_path / "bag").mkdir()
    make_database(tmp_path / "bag" / "bag_0.db3", part=rows)
    topics = {"/old_a": ("geometry_msgs/msg/Point", 3), "/old_b": ("geometry_msgs/msg/Point", 3)}
    (tmp_path / "bag" / "metadata.yaml").write_text(make_metadata(["bag_0.db3"], topics))
    bag = read_bag(tmp_path / "bag")
    assert "a, b: topics that metadata.yaml calls /old_a, /old_b: 2" in bag.problems
    assert bag.is_complete
    (tmp_path / "bag" / "metadata.yaml").write_text(
        make_metadata(["bag_0.db3"], {**topics, "/old_c": topics["/old_a"]})
    )
    assert not read_bag(tmp_path / "bag").is_complete


def test_a_hole_in_a_split_is_a_loss(odd_bag: Odd) -> None:
    bag = read_bag(odd_bag("split with a hole"))
    assert "x_1.db3 missing from the files of a split bag: 1" in bag.problems
    assert not bag.is_complete


def test_one_file_of_a_split_without_metadata_is_read_alone(odd_bag: Odd) -> None:
    folder = odd_bag("split with a hole")
    bag = read_bag(folder / "x_2.db3")
    assert sum(topic.count for topic in bag.topics.values()) == 7
    assert "x_2.db3 read alone; beside it, of the same split bag: x_0.db3: 1" in bag.problems


def test_a_file_that_is_there_twice_is_read_once(odd_bag: Odd) -> None:
    import zstandard

    folder = odd_bag("split with a hole")
    (folder / "x_0.db3.zstd").write_bytes(zstandard.compress((folder / "x_0.db3").read_bytes()))
    bag = read_bag(folder)
    assert sum(topic.count for topic in bag.topics.values()) == 14
    assert "x_0.db3.zstd not read, because x_0.db3 is there, too: 1" in bag.problems


def test_a_bag_of_ros_1_is_named_with_its_converter(tmp_path: Path) -> None:
    (tmp_path / "old.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    for path in (tmp_path / "old.bag", tmp_path):
        with pytest.raises(BagError, match=f"is a ROS 1 bag.*rosbags-convert --src {tmp_path}/old.bag --dst"):
            read_bag(path)


def test_the_folder_above_a_bag_names_it(odd_bag: Odd) -> None:
    with pytest.raises(BagError, match="there is one in its folder bag"):
        read_bag(odd_bag("directory of Humble").parent)


def test_the_true_reason_why_a_database_is_not_decoded(tmp_path: Path, make_database: Callable[..., Path]) -> None:
    event = [("/add/_service_event", "my_srvs/srv/Add_Event", 1, b"\0\1\0\0" + bytes(60))]
    bag = read_bag(make_database(tmp_path / "a.db3", part=event))
    assert any("/add/_service_event: topic that cannot be decoded: the bag does not" in text for text in bag.problems)
    bag = read_bag(make_database(tmp_path / "b.db3", form="protobuf"))
    with pytest.raises(
        BagError, match="/point: cannot be decoded: its messages are encoded as 'protobuf'; cdr and json"
    ):
        bag["/point"]
    assert len(bag.payloads("/point")) == 7


def test_rows_of_a_topic_that_is_not_described_are_counted(tmp_path: Path, make_database: Callable[..., Path]) -> None:
    path = make_database(tmp_path / "a.db3")
    database = sqlite3.connect(path)
    database.execute("DELETE FROM topics WHERE name = '/point'")
    database.commit()
    database.close()
    bag = read_bag(path)
    assert "message of topic 1, which is not described, so that its name is not known: 7" in bag.problems
    assert not bag.is_complete


def test_a_damaged_database_is_read_behind_the_damage(tmp_path: Path, make_database: Callable[..., Path]) -> None:
    """Pages of messages in the middle are overwritten: what sqlite3 finds before and behind them comes back."""
    rows = [("/point", "geometry_msgs/msg/Point", i + 1, b"\0\1\0\0" + bytes(24 + 500)) for i in range(400)]
    path = make_database(tmp_path / "a.db3", part=rows)
    data = bytearray(path.read_bytes())
    page = 4096
    leaves = [at for at in range(0, len(data), page) if data[at] == 0x0D and data.count(bytes(300), at, at + page)]
    for at in leaves[20:22]:
        data[at : at + page] = b"\xff" * page
    path.write_bytes(data)
    bag = read_bag(path)
    assert 360 < len(bag.payloads("/point")) < 400
    assert not bag.is_complete


def test_a_database_that_is_no_bag_is_refused(tmp_path: Path) -> None:
    sqlite3.connect(tmp_path / "a.db3").execute("CREATE TABLE t(x)").connection.close()
    with pytest.raises(BagError, match="a database, but no bag: it lacks rosbag2's tables `topics` and `messages`"):
        read_bag(tmp_path / "a.db3")


def test_what_a_database_lacks_or_holds_in_another_form_does_not_refuse_it(
    tmp_path: Path, make_database: Callable[..., Path]
) -> None:
    path = make_database(tmp_path / "a.db3")
    with contextlib.closing(sqlite3.connect(path)) as database:
        database.executescript(
            "ALTER TABLE schema DROP COLUMN ros_distro;"
            "CREATE TABLE message_definitions(id INTEGER, topic_type BLOB, encoding TEXT, encoded_message_definition);"
        )
        text = b"float64[3] values\nstring unit"
        database.execute("INSERT INTO message_definitions VALUES (1, ?, 'ros2msg', ?)", (b"my_msgs/msg/Reading", text))
        database.execute("CREATE TABLE loose AS SELECT * FROM topics")
        database.executescript("DROP TABLE topics; ALTER TABLE loose RENAME TO topics;")
        database.execute("INSERT INTO topics VALUES ('no number', NULL, NULL, NULL, NULL)")
        database.commit()
    bag = read_bag(path)
    assert bag["/reading"]["values"][:, 0].tolist() == [float(i) for i in range(7)]
    assert len(bag["/point"]) == 7
    assert "row that describes no topic, left out: 1" in bag.problems


# -- files that were compressed by hand -------------------------------------------------------------------------------


def _lz4(data: bytes) -> bytes:
    import lz4.frame

    return bytes(lz4.frame.compress(data))


PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".gz": gzip.compress, ".xz": lzma.compress, ".bz2": bz2.compress, ".lz4": _lz4, ".zst": zstandard.compress,
}  # fmt: skip


@pytest.mark.parametrize("ending", PACKERS)
@pytest.mark.parametrize("form", ["mcap", "sqlite3 of Humble", "directory of Humble", "directory without metadata"])
def test_a_file_that_was_compressed_by_hand_is_read(
    tmp_path: Path, odd_bag: Odd, by_others: Callable[[Path], Payloads], ending: str, form: str
) -> None:
    path = odd_bag(form.replace("without metadata", "of Humble"))
    original = by_others(path)
    file = path if path.is_file() else path / "bag_0.db3"
    file.with_name(file.name + ending).write_bytes(PACKERS[ending](file.read_bytes()))
    file.unlink()
    if form == "directory without metadata":
        (path / "metadata.yaml").unlink()
    bag = read_bag(path if path.is_dir() else path.with_name(path.name + ending))
    assert {topic: len(bag.payloads(topic)) for topic in bag.topics} == {t: len(data) for t, data in original.items()}
    assert bag.is_complete


@pytest.mark.parametrize("ending", PACKERS)
def test_of_a_compressed_file_that_was_cut_the_beginning_is_read(tmp_path: Path, odd_bag: Odd, ending: str) -> None:
    path = odd_bag("mcap")
    size = 2**21 if ending == ".bz2" else 2**17  # bzip2 inflates whole blocks of 900 kB
    data = path.read_bytes() + os.urandom(size)  # behind the end, so that the cut is there
    packed = PACKERS[ending](data)
    (tmp_path / f"cut.mcap{ending}").write_bytes(packed[: len(packed) * 3 // 4])
    bag = read_bag(tmp_path / f"cut.mcap{ending}")
    assert len(bag["/point"]) == 7
    assert any(problem.startswith(f"cut.mcap{ending}: compressed file that is damaged") for problem in bag.problems)
    assert not bag.is_complete


@pytest.mark.parametrize(("name", "command"), [("bags.tar.gz", "tar xf"), ("bags.tar", "tar xf"), ("a.zip", "unzip")])
def test_an_archive_is_refused_with_the_command_that_unpacks_it(
    tmp_path: Path, odd_bag: Odd, name: str, command: str
) -> None:
    bag = odd_bag("mcap")
    if name.endswith(".zip"):
        with zipfile.ZipFile(tmp_path / name, "w") as archive:
            archive.write(bag)
    else:
        with tarfile.open(tmp_path / name, "w:gz" if name.endswith(".gz") else "w") as tar:
            tar.add(bag)
    with pytest.raises(BagError, match=f"is an archive: `{command} {tmp_path}/{name}` unpacks it") as error:
        read_bag(tmp_path / name)
    assert "\n" not in str(error.value)


def test_an_error_names_the_compressed_file_and_not_what_was_made_of_it(tmp_path: Path) -> None:
    (tmp_path / "a.mcap.gz").write_bytes(gzip.compress(b"no bag at all, but long enough for it"))
    with pytest.raises(BagError, match=f"^{tmp_path}/a.mcap.gz: is not an MCAP file"):
        read_bag(tmp_path / "a.mcap.gz")


def test_a_data_file_is_read_once_whatever_its_names(odd_bag: Odd, tmp_path: Path) -> None:
    folder = odd_bag("no storage identifier")
    data = next(folder.glob("*.db3"))
    links = [folder / f"again_{i}.db3" for i in range(5)]
    for link in links:
        link.symlink_to(data.name)
    metadata = folder / "metadata.yaml"
    names = [f"./{data.name}", f"elsewhere/{data.name}", *(link.name for link in links)]
    metadata.write_text(metadata.read_text().replace(f'"{data.name}"', json.dumps(names)[1:-1]))
    bag = read_bag(folder)
    assert bag.topics["/point"].count == 7
    assert f"again_0.db3 is {data.name} by another name, not read again: 1" in bag.problems


@pytest.mark.parametrize("name", ["bag.mcap", "metadata.yaml"])
def test_a_pipe_is_no_bag(tmp_path: Path, name: str) -> None:
    os.mkfifo(tmp_path / name)
    for path in (tmp_path / name, tmp_path):
        with pytest.raises(BagError, match=r"is a pipe or a device|there is no .mcap or .db3 file"):
            read_bag(path)
    with pytest.raises(BagError, match="is a pipe or a device"):
        read_bag("/dev/zero")


def test_what_a_terminal_would_obey_is_shown() -> None:
    assert printable("/\x1b]0;owned\x07\x9b2J\u202epose\udc80") == r"/\x1b]0;owned\x07\x9b2J\u202epose\udc80"
    assert printable("Straße 5 µm\n") == "Straße 5 µm\n"
