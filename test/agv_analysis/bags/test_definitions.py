"""Types that a bag does not define, definitions in IDL, service events, and messages in JSON."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from agv_analysis.bags import Bag, BagError, read_bag
from agv_analysis.bags.message_batch import NO_DEFINITION
from agv_analysis.bags.recover import recover
from agv_analysis.cli import main

RANGE = "sensor_msgs/msg/Range"
HUMBLE, JAZZY = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS2_JAZZY)
"""In Iron `variance` was added to Range."""


def write(
    path: Path, kind: str, payloads: list[bytes], schema: tuple[str, bytes] = ("ros2msg", b""), form: str = "cdr",
    topic: str = "/t", about: dict[str, str] | None = None, distro: str = "",
) -> Path:  # fmt: skip
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2", library="test")
        channel = writer.register_channel(topic, form, writer.register_schema(kind, *schema), about or {})
        for i, payload in enumerate(payloads):
            writer.add_message(channel, i, payload, i)
        if distro:
            writer.add_metadata("rosbag2", {"serialized_metadata": f"version: 9\nros_distro: {distro}\n"})
        writer.finish()  # type: ignore[no-untyped-call]
    return path


def ranges(store: Any) -> list[bytes]:
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "sonar")
    extra = (0.25,) if store is JAZZY else ()
    return [
        bytes(store.serialize_cdr(types[RANGE](header, 1, 0.5, 0.1, 4.0, float(i), *extra), RANGE)) for i in range(3)
    ]


def borrowed(bag: Bag) -> list[str]:
    return [problem for problem in bag.problems if "definition is not in the bag" in problem]


@pytest.mark.parametrize(
    ("store", "distro", "source"),
    [
        (HUMBLE, "humble", "ROS 2 humble"), (JAZZY, "jazzy", "ROS 2 jazzy"), (HUMBLE, "", "ROS 2 dashing to humble"),
        (JAZZY, "", "ROS 2 iron to lyrical"), (JAZZY, "rolling", "ROS 2 iron to lyrical"),
    ],
)  # fmt: skip
def test_the_distribution_that_the_bag_names_or_that_fits_gives_the_definition(
    tmp_path: Path, store: Any, distro: str, source: str
) -> None:
    bag = read_bag(write(tmp_path / "a.mcap", RANGE, ranges(store), distro=distro))
    assert bag["/t"]["range"].tolist() == [0.0, 1.0, 2.0]
    assert bag["/t"]["header.frame_id"].tolist() == [b"sonar"] * 3
    assert ("variance" in (bag["/t"].dtype.names or ())) == (store is JAZZY)
    assert borrowed(bag) == [f"/t: topic whose definition is not in the bag, that of {source} used: 1"]
    assert bag.is_complete


def test_a_named_distribution_that_does_not_fit_decodes_nothing(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RANGE, ranges(JAZZY), distro="humble")
    with pytest.raises(BagError, match="the bag does not hold the definition of its type"):
        read_bag(path)["/t"]
    assert recover(path, tmp_path / "out.mcap").counts == {"/t": 3}
    assert read_bag(tmp_path / "out.mcap").payloads("/t") == ranges(JAZZY)


def test_the_recorded_hash_decides_before_the_distribution(tmp_path: Path) -> None:
    about = {"topic_type_hash": JAZZY.hash_rihs01(RANGE)}
    bag = read_bag(write(tmp_path / "a.mcap", RANGE, ranges(JAZZY), about=about))
    assert bag["/t"]["variance"].tolist() == [0.25] * 3


def test_a_recovered_bag_holds_the_definition_that_described_its_messages(tmp_path: Path) -> None:
    recovery = recover(write(tmp_path / "a.mcap", RANGE, ranges(HUMBLE)), tmp_path / "out.mcap")
    said = "/t: topic whose definition is not in the bag, that of ROS 2 dashing to humble written: 1"
    assert said in recovery.problems
    bag = read_bag(tmp_path / "out.mcap")
    assert bag.problems == ()
    assert bag["/t"]["range"].tolist() == [0.0, 1.0, 2.0]


def test_a_type_without_members_needs_no_definition(tmp_path: Path) -> None:
    for kind in ("std_msgs/msg/Empty", "my_msgs/msg/Ping"):
        bag = read_bag(write(tmp_path / "a.mcap", kind, [b"\0\1\0\0\0"] * 2))
        assert len(bag["/t"]) == 2
        assert bag.problems == ()


ZEROS = b"\0\1\0\0\0"
"""As of a message without members, or with members that are zero."""


@pytest.mark.parametrize(
    "payloads",
    [
        [ZEROS, ZEROS, b"\0\1\0\0\1", ZEROS],
        [ZEROS + bytes(3), ZEROS + b"\0\0\1"],
        [ZEROS] * 200 + [b"\0\1\0\0" + bytes(5)],
        [b"\0\1\0\0" + bytes(8)] * 2,
    ],
)
@pytest.mark.parametrize("files", [1, 2])
def test_what_may_have_no_members_is_judged_by_all_of_its_messages(
    tmp_path: Path, payloads: list[bytes], files: int
) -> None:
    (tmp_path / "bag").mkdir()
    for number in range(files):
        some = payloads[: len(payloads) // 2] if number < files - 1 else payloads[len(payloads) // 2 * (files - 1) :]
        write(tmp_path / "bag" / f"bag_{number}.mcap", "my_msgs/msg/Flag", some)
    bag = read_bag(tmp_path / "bag")
    assert any(problem.startswith(f"/t: topic that cannot be decoded: {NO_DEFINITION}") for problem in bag.problems)
    assert bag.is_complete
    assert bag.topics["/t"].definition == ""
    assert bag.payloads("/t") == payloads
    assert len(bag.log_times("/t")) == len(payloads)
    recovery = recover(tmp_path / "bag", tmp_path / "out")
    assert recovery.is_complete
    assert f"/t: message copied as it is, unchecked ({NO_DEFINITION}): {len(payloads)}" in recovery.problems
    assert read_bag(tmp_path / "out").payloads("/t") == payloads


ARRAY = "visualization_msgs/msg/MarkerArray"
FOXY = get_typestore(Stores.ROS2_FOXY)
"""In Humble `texture` and more were added to Marker; without markers, arrays of both look the same."""


def marker_array(store: Any, count: int) -> bytes:
    types = store.types

    def blank(kind: str) -> Any:
        """A message of zeros, whatever members this distribution gives it."""
        values: list[Any] = []
        for _, (form, content) in store.fielddefs[kind][1]:
            if form.name == "BASE":
                values.append("" if content[0] == "string" else 0)
            elif form.name == "NAME":
                values.append(blank(content))
            else:
                values.append(np.zeros(0, np.uint8) if content[0][1][0] == "uint8" else [])
        return types[kind](*values)

    return bytes(store.serialize_cdr(types[ARRAY]([blank("visualization_msgs/msg/Marker")] * count), ARRAY))


@pytest.mark.parametrize(
    ("store", "source"), [(FOXY, "foxy to galactic"), (HUMBLE, "jazzy to lyrical")], ids=["Foxy", "Humble"]
)
def test_of_several_definitions_all_messages_decide(tmp_path: Path, store: Any, source: str) -> None:
    """As a node starts that has nothing to show yet."""
    payloads = [marker_array(store, count) for count in (0, 0, 2, 1)]
    path = write(tmp_path / "a.mcap", ARRAY, payloads)
    bag = read_bag(path)
    assert bag["/t"]["len(markers)"].tolist() == [0, 0, 2, 1]
    assert bag.is_complete
    assert borrowed(bag) == [f"/t: topic whose definition is not in the bag, that of ROS 2 {source} used: 1"]
    assert f"that of ROS 2 {source} written: 1" in "".join(recover(path, tmp_path / "out.mcap").problems)
    assert read_bag(tmp_path / "out.mcap")["/t"]["len(markers)"].tolist() == [0, 0, 2, 1]


def test_what_several_definitions_describe_is_not_decoded(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", ARRAY, [marker_array(HUMBLE, 0)] * 3)
    bag = read_bag(path)
    with pytest.raises(BagError, match="there are several that describe its messages"):
        bag["/t"]
    assert bag.is_complete
    assert recover(path, tmp_path / "out.mcap").counts == {"/t": 3}


def test_one_damaged_message_does_not_decide(tmp_path: Path) -> None:
    """Be it the first: the definition is that of the others."""
    payloads = [ranges(HUMBLE)[0][:-7], *ranges(HUMBLE)]
    bag = read_bag(write(tmp_path / "a.mcap", RANGE, payloads, distro="humble"))
    assert bag["/t"]["range"].tolist() == [0.0, 1.0, 2.0]
    assert not bag.is_complete


def test_a_definition_from_elsewhere_that_describes_few_messages_is_not_theirs(tmp_path: Path) -> None:
    (tmp_path / "Few.msg").write_text("float32[] x\n")
    payloads = [b"\0\1\0\0\0\0\0\0"] + [b"\0\1\0\0\2\0\0\0" + bytes(32)] * 5
    path = write(tmp_path / "a.mcap", "my_msgs/msg/Few", payloads)
    bag = read_bag(path, definitions=tmp_path)
    with pytest.raises(BagError, match="does not describe 5 of its 6 messages"):
        bag["/t"]
    assert bag.is_complete
    recovery = recover(path, tmp_path / "out.mcap", definitions=tmp_path)
    assert recovery.is_complete
    assert recovery.counts == {"/t": 6}


# -- wide strings -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", [2, 4])
def test_wide_strings_of_either_width(tmp_path: Path, width: int) -> None:
    """rmw_fastrtps of Jazzy writes a character in four bytes, newer Fast CDR in two; both count characters."""
    texts = ["", "a", "grün", "€", "\N{PERSONAL COMPUTER}!"]

    def wide(text: str) -> bytes:
        units = np.frombuffer(text.encode("utf-16-le"), "<u2")
        return len(units).to_bytes(4, "little") + units.astype(f"<u{width}").tobytes()

    def message(text: str) -> bytes:
        data = wide(text)
        data += bytes(-len(data) % 4) + (2).to_bytes(4, "little") + wide("x")
        data += bytes(-len(data) % 4) + wide(text)
        return b"\0\1\0\0" + data + bytes(-len(data) % 4) + (7).to_bytes(4, "little")

    schema = ("ros2msg", b"wstring name\nwstring[] many\nint32 after")
    rows = read_bag(write(tmp_path / "a.mcap", "my_msgs/msg/Wide", [message(text) for text in texts], schema))["/t"]
    assert [name.decode() for name in rows["name"].tolist()] == texts
    assert [[name.decode() for name in row] for row in rows["many"].tolist()] == [["x", text] for text in texts]
    assert rows["after"].tolist() == [7] * 5


def test_wide_strings_as_jazzy_writes_them(tmp_path: Path) -> None:
    """By rclpy.serialize_message; at the end are bytes that it reserved and did not use."""
    payload = bytes.fromhex(
        "00010000" "00000000" "0c000000" "48000000650000006c0000006c0000006f00000020000000770000006f00000072000000"
        "6c0000006400000021000000" "0c000000" "48000000650000006c0000006c000000f60000002000000077000000f6000000"
        "720000006c0000006400000021000000" "07000000" "cf300000ed300000fc300000ef300000fc300000eb300000c9300000"
        "000000000000000000000000" "00000000" "00000000" "050000006a0000000700000000000000000000000000000000000000"
    )  # fmt: skip
    text = (
        'wstring wstring_value\nwstring wstring_value_default1 "Hello world!"\nwstring wstring_value_default2 \'Hellö '
        "wörld!'\nwstring wstring_value_default3 'ハローワールド'\nwstring[3] array_of_wstrings\n"
        "wstring[<=3] bounded_sequence_of_wstrings\nwstring[] unbounded_sequence_of_wstrings\n"
    )
    rows = read_bag(write(tmp_path / "a.mcap", "test_msgs/msg/WStrings", [payload], ("ros2msg", text.encode())))["/t"]
    defaults = [rows[f"wstring_value_default{i}"][0].decode() for i in (1, 2, 3)]
    assert defaults == ["Hello world!", "Hellö wörld!", "ハローワールド"]
    assert rows["array_of_wstrings"].tolist() == [[b""] * 3]


def test_messages_that_a_node_serialised_for_a_bag(tmp_path: Path) -> None:
    """As the tutorials of rosbag2 do it: what was reserved for sequences without elements is part of the message."""
    payload = bytes.fromhex(
        "00010000" "00000000" "00000000" "02000000" "620057f0" "01000000" "05000000" "6c65667400" "9258f0" "01000000"
        "a0edccf4" "000000000000e03f" "00000000" "00000000" "dc7f0000300f5bf4"
    )  # fmt: skip
    schema = ("ros2msg", JAZZY.generate_msgdef("sensor_msgs/msg/JointState", ros_version=2)[0].encode())
    bag = read_bag(write(tmp_path / "a.mcap", "sensor_msgs/msg/JointState", [payload], schema))
    assert bag["/t"]["name"].tolist() == [[b"left"]]
    assert bag["/t"]["position"].tolist() == [[0.5]]
    assert bag.is_complete
    longer = read_bag(write(tmp_path / "b.mcap", "sensor_msgs/msg/JointState", [payload + bytes(8)], schema))
    assert not longer.is_complete


def test_wide_strings_without_any_character_have_no_width(tmp_path: Path) -> None:
    schema = ("ros2msg", b"wstring name\nint32 after")
    payloads = [b"\0\1\0\0\0\0\0\0\7\0\0\0"] * 2
    bag = read_bag(write(tmp_path / "a.mcap", "my_msgs/msg/Wide", payloads, schema))
    assert bag["/t"]["name"].tolist() == [b"", b""]
    assert bag["/t"]["after"].tolist() == [7, 7]
    assert bag.problems == ()


WITHOUT_ROSBAGS = """
import sys
sys.modules["rosbags"] = None
from agv_analysis.bags import BagError, read_bag
bag = read_bag(sys.argv[1])
print(len(bag.payloads("/reading")))
try:
    bag["/reading"]
except BagError as error:
    print(error)
"""


def test_without_rosbags_sqlite3_is_read_and_its_types_are_asked_for(
    tmp_path: Path, make_database: Callable[..., Path]
) -> None:
    path = make_database(tmp_path / "a.db3")
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_ROSBAGS, str(path)], capture_output=True, text=True, check=True,
        cwd=Path(__file__).parents[3],
    )  # fmt: skip
    count, error = done.stdout.splitlines()
    assert count == "7"
    assert "those of ROS 2 come with rosbags: `pip install rosbags`" in error


def test_a_definition_without_those_of_the_types_in_it_is_completed(tmp_path: Path) -> None:
    """As writers leave it that put a .msg file into a bag and no more."""
    text = JAZZY.generate_msgdef(RANGE, ros_version=2)[0].split("\n====")[0]
    path = write(tmp_path / "a.mcap", RANGE, ranges(JAZZY), ("ros2msg", text.encode()))
    bag = read_bag(path)
    assert bag["/t"]["range"].tolist() == [0.0, 1.0, 2.0]
    assert bag["/t"]["header.frame_id"].tolist() == [b"sonar"] * 3
    assert "/t: topic whose definition lacks types, those of ROS 2 used: 1" in bag.problems
    unknown = write(tmp_path / "b.mcap", WHEEL, wheels(), ("ros2msg", WHEEL_MSG.encode()))
    with pytest.raises(BagError, match=r"its definition uses the type .* without describing it"):
        read_bag(unknown)["/t"]
    (tmp_path / "Side.msg").write_text(SIDE_MSG)
    assert_wheels(read_bag(unknown, definitions=tmp_path))


# -- a folder of definitions ------------------------------------------------------------------------------------------

WHEEL_MSG = "std_msgs/Header header\nSide side\ngeometry_msgs/Point[] contacts\nfloat32[2] force\n"
SIDE_MSG = "uint8 LEFT=0\nuint8 value\nstring name\n"
WHEEL_IDL = """
#include "std_msgs/msg/Header.idl"
module my_msgs { module msg {
  typedef float float__2[2];
  struct Wheel {
    std_msgs::msg::Header header;
    my_msgs::msg::Side side;
    @verbatim (language="comment", text= "where it touches")
    sequence<geometry_msgs::msg::Point> contacts;
    @unit (value="N")
    float__2 force;
  };
}; };
"""
SIDE_IDL = """
module my_msgs { module msg {
  module Side_Constants { const uint8 LEFT = 0; };
  struct Side { uint8 value; string name; };
}; };
"""
WHEEL = "my_msgs/msg/Wheel"


def wheels() -> list[bytes]:
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register({**get_types_from_msg(WHEEL_MSG, WHEEL), **get_types_from_msg(SIDE_MSG, "my_msgs/msg/Side")})
    types = store.types
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](1, 2), "base")
    point = types["geometry_msgs/msg/Point"]
    return [
        bytes(
            store.serialize_cdr(
                types[WHEEL](
                    header, types["my_msgs/msg/Side"](i, "l" * i), [point(1.0, 2.0, float(i))] * i,
                    np.array([0.5, i], np.float32),
                ),
                WHEEL,
            )
        )
        for i in range(3)
    ]  # fmt: skip


def assert_wheels(bag: Bag) -> None:
    rows = bag["/t"]
    assert rows["side.value"].tolist() == [0, 1, 2]
    assert rows["side.name"].tolist() == [b"", b"l", b"ll"]
    assert rows["len(contacts)"].tolist() == [0, 1, 2]
    assert rows["contacts.z"][2].tolist() == [2.0, 2.0]
    assert rows["force"].tolist() == [[0.5, 0.0], [0.5, 1.0], [0.5, 2.0]]


FOLDERS = {
    "share of a workspace": ("install/share/my_msgs/msg/Wheel.msg", "install/share/my_msgs/msg/Side.msg"),
    "package": ("my_msgs/msg/Wheel.msg", "my_msgs/msg/Side.msg"),
    "loose files": ("Wheel.msg", "Side.msg"),
    "IDL": ("my_msgs/msg/Wheel.idl", "my_msgs/msg/Side.idl"),
    "both": ("my_msgs/msg/Wheel.idl", "my_msgs/msg/Side.msg"),
}  # fmt: skip


@pytest.mark.parametrize("kind", FOLDERS)
def test_a_folder_of_definitions(tmp_path: Path, kind: str) -> None:
    folder = tmp_path / "ws"
    for name in FOLDERS[kind]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        texts = (WHEEL_MSG, SIDE_MSG) if name.endswith(".msg") else (WHEEL_IDL, SIDE_IDL)
        (folder / name).write_text(texts["Side" in name])
    path = write(tmp_path / "a.mcap", WHEEL, wheels())
    with pytest.raises(BagError, match="does not hold the definition"):
        read_bag(path)["/t"]
    bag = read_bag(path, definitions=folder)
    assert_wheels(bag)
    assert borrowed(bag) == [f"/t: topic whose definition is not in the bag, that of {folder} used: 1"]
    arguments = ["bag", "recover", str(path), str(tmp_path / "out.mcap"), "--definitions", str(folder)]
    assert CliRunner().invoke(main, arguments, catch_exceptions=False).exit_code == 0
    assert_wheels(read_bag(tmp_path / "out.mcap"))


def test_a_folder_with_two_definitions_of_one_type_is_not_believed(tmp_path: Path) -> None:
    for place, text in (("src", SIDE_MSG), ("install", "string name\nuint8 value\n")):
        folder = tmp_path / "ws" / place / "my_msgs" / "msg"
        folder.mkdir(parents=True)
        (folder / "Side.msg").write_text(text)
    path = write(tmp_path / "a.mcap", "my_msgs/msg/Side", [b"\0\1\0\0\7\0\0\0\1\0\0\0\0"])
    with pytest.raises(BagError, match=r"install/my_msgs/msg/Side.msg and .*src/my_msgs/msg/Side.msg give different"):
        read_bag(path, definitions=tmp_path / "ws")["/t"]


def test_a_folder_without_definitions_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", WHEEL, wheels())
    with pytest.raises(BagError, match=r"no definitions: there is no \.msg, \.idl or \.srv file in it"):
        read_bag(path, definitions=tmp_path)


@pytest.mark.parametrize(
    "kind", ["../../etc/passwd", "os/msg/path", "a/b/c/d", "", "my_msgs", "/msg/X", "x/srv/_Event"]
)
def test_names_of_types_that_are_none_are_looked_up_nowhere(tmp_path: Path, kind: str) -> None:
    bag = read_bag(write(tmp_path / "a.mcap", kind, wheels()))
    assert any(problem.startswith("/t: topic that cannot be decoded") for problem in bag.problems)


# -- definitions in IDL within the bag --------------------------------------------------------------------------------


def test_definitions_in_idl(tmp_path: Path) -> None:
    """As rosbag2 writes them: each behind a line of `=` and one with its name, in any order."""
    time = "module builtin_interfaces { module msg { struct Time { long sec; unsigned long nanosec; }; }; };"
    header = """#include "builtin_interfaces/msg/Time.idl"
    module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };"""
    point = "module geometry_msgs { module msg { struct Point { double x; double y; double z; }; }; };"
    parts = {
        WHEEL: WHEEL_IDL, "std_msgs/msg/Header": header, "builtin_interfaces/msg/Time": time,
        "my_msgs/msg/Side": SIDE_IDL, "geometry_msgs/msg/Point": point,
    }  # fmt: skip
    text = "".join(f"{'=' * 80}\nIDL: {name}\n{part}\n" for name, part in parts.items())
    bag = read_bag(write(tmp_path / "a.mcap", WHEEL, wheels(), ("ros2idl", text.encode())))
    assert_wheels(bag)
    assert bag.problems == ()


@pytest.mark.parametrize("text", ["struct {", "module a { module msg { struct B { double x; }; }; };"])
def test_idl_that_does_not_describe_the_type_is_refused(tmp_path: Path, text: str) -> None:
    bag = read_bag(write(tmp_path / "a.mcap", WHEEL, wheels(), ("ros2idl", text.encode())))
    with pytest.raises(BagError, match="its definition in IDL"):
        bag["/t"]


# -- service events ---------------------------------------------------------------------------------------------------

EVENT = "my_srvs/srv/Add_Event"


def events() -> list[bytes]:
    """By rosbags, which knows no services, as messages of the same members."""
    store = get_typestore(Stores.ROS2_JAZZY)
    request_type, response_type, event_type = (f"my_srvs/msg/{name}" for name in ("Request", "Response", "Event"))
    event = "service_msgs/ServiceEventInfo info\nRequest[<=1] request\nResponse[<=1] response"
    for kind, text in ((request_type, "int64 a\nstring why"), (response_type, "int64 sum"), (event_type, event)):
        store.register(get_types_from_msg(text, kind))
    types = store.types
    found = []
    for i in range(4):
        gid = np.arange(16, dtype=np.uint8)
        info = types["service_msgs/msg/ServiceEventInfo"](i, types["builtin_interfaces/msg/Time"](5, i), gid, 100 + i)
        request = [types[request_type](i, "because")] if i < 2 else []
        response = [types[response_type](-i)] if i >= 2 else []
        found.append(bytes(store.serialize_cdr(types[event_type](info, request, response), event_type)))
    return found


@pytest.mark.parametrize("form", ["mcap", "sqlite3"])
def test_service_events(tmp_path: Path, make_database: Callable[..., Path], form: str) -> None:
    """The recorder of Jazzy leaves their definition empty."""
    folder = tmp_path / "my_srvs" / "srv"
    folder.mkdir(parents=True)
    (folder / "Add.srv").write_text("int64 a\nstring why\n---\nint64 sum\n")
    if form == "mcap":
        path = write(tmp_path / "a.mcap", EVENT, events(), topic="/add/_service_event")
    else:
        part = [("/add/_service_event", EVENT, i, data) for i, data in enumerate(events())]
        path = make_database(tmp_path / "a.db3", part=part)
    rows = read_bag(path, definitions=tmp_path)["/add/_service_event"]
    assert rows["info.event_type"].tolist() == [0, 1, 2, 3]
    assert rows["info.sequence_number"].tolist() == [100, 101, 102, 103]
    assert rows["len(request)"].tolist() == [1, 1, 0, 0]
    assert rows["request.why"][:2].tolist() == [[b"because"], [b"because"]]
    assert rows["response.sum"][2:].tolist() == [[-2], [-3]]


# -- JSON -------------------------------------------------------------------------------------------------------------


def read_json(tmp_path: Path, *contents: Any) -> Bag:
    payloads = [content if isinstance(content, bytes) else json.dumps(content).encode() for content in contents]
    return read_bag(write(tmp_path / "a.mcap", "Pose", payloads, ("jsonschema", b"{}"), "json"))


def test_messages_in_json(tmp_path: Path) -> None:
    bag = read_json(
        tmp_path,
        {"pose": {"x": 1, "y": 0.5}, "name": "one", "ok": True, "id": 2**60, "scan": [1.0, 2.0], "tags": [{"a": 1}]},
        {"pose": {"x": 2, "y": 2}, "name": "three €", "ok": False, "id": -7, "scan": [], "tags": [{"a": 2}, {"a": 3}]},
    )
    rows = bag["/t"]
    assert rows["pose.x"].tolist() == [1, 2]
    assert rows["pose.y"].tolist() == [0.5, 2.0]
    assert rows["name"].tolist() == [b"one", "three €".encode()]
    assert rows["ok"].tolist() == [True, False]
    assert rows["id"].tolist() == [2**60, -7]
    assert rows["len(scan)"].tolist() == [2, 0]
    assert rows["scan"][0].tolist() == [1.0, 2.0]
    assert np.isnan(rows["scan"][1]).all()
    assert rows["tags.a"].tolist() == [[1, 0], [2, 3]]
    assert rows["log_time_ns"].tolist() == [0, 1]
    assert bag.problems == ()


def test_json_of_unlike_messages(tmp_path: Path) -> None:
    bag = read_json(tmp_path, {"a": 1, "b": None, "c": "x"}, {"b": 2.5, "c": 3}, b"[1]", b"{", {"a.b": 4})
    rows = bag["/t"]
    assert np.array_equal(rows["a"], [1.0, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(rows["b"], [np.nan, 2.5, np.nan], equal_nan=True)
    assert rows["c"].tolist() == [b"x", b"3", b""]
    assert rows['"a.b"'].tolist()[2] == 4.0
    assert "/t: message that is not of its type, left out (no JSON object: a list where an object is expected): 2" in (
        bag.problems
    )
    assert not bag.is_complete


@pytest.mark.parametrize(
    ("contents", "why"),
    [
        (({"a": [1]}, {"a": 1}), "a is a list in some of its messages and not in others"),
        (({"a": 2**64}, {}), "a has whole numbers of more than 64 bits"),
        (({"a": 2**60 + 1}, {}), "a has numbers beyond 2"),
        (({"a": 2**60 + 1}, {"a": 0.5}), "a has fractions and whole numbers beyond 2"),
    ],
)
def test_json_that_would_give_wrong_numbers_is_refused(tmp_path: Path, contents: tuple[Any, ...], why: str) -> None:
    bag = read_json(tmp_path, *contents)
    with pytest.raises(BagError, match=why):
        bag["/t"]
    assert len(bag.payloads("/t")) == 2


def test_a_topic_of_json_without_objects_is_no_loss(tmp_path: Path) -> None:
    bag = read_json(tmp_path, [1, 2], 3, "four")
    with pytest.raises(BagError, match="no JSON object: a list where an object is expected"):
        bag["/t"]
    assert bag.is_complete
    assert bag.log_times("/t").tolist() == [0, 1, 2]
    assert len(bag.payloads("/t")) == 3


def test_json_with_one_long_list_does_not_take_all_memory(tmp_path: Path) -> None:
    bag = read_json(tmp_path, *[{"a": [0.5]}] * 3000, {"a": [0.5] * 20_000})
    with pytest.raises(BagError, match="its strings or sequences differ so much in length"):
        bag["/t"]
