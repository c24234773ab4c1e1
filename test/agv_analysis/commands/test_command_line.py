"""`agv-ncs` as a person meets it: what it prints, what it writes, what it says to bad input."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

REPOSITORY = Path(__file__).parents[3]
AgvNcs = Callable[..., tuple[int, str]]

WITHOUT_ROS = (
    "import sys\n"
    "class Gone:\n"
    "    def find_spec(self, name, *_):\n"
    "        if name.split('.')[0] in ('rclpy', 'geometry_msgs', 'nav_msgs', 'sensor_msgs', 'rcl_interfaces'):\n"
    "            raise ModuleNotFoundError(f'No module named {name!r}', name=name)\n"
    "sys.meta_path.insert(0, Gone())\n"
    "from agv_analysis.cli import main\n"
    "main()\n"
)


def last_line(said: str) -> str:
    return said.strip().splitlines()[-1]


def test_help_shows_examples(agv_ncs: AgvNcs) -> None:
    for command in ((), ("run",), ("analyse",)):
        status, said = agv_ncs(*command, "--help")
        assert status == 0
        assert "Examples:" in said
        assert "  agv-ncs " in said


def test_the_list_of_commands_has_whole_sentences(agv_ncs: AgvNcs) -> None:
    for group in ((), ("bag",)):
        status, said = agv_ncs(*group, "--help")
        listed = said.partition("Commands:\n")[2].splitlines()
        assert status == 0
        assert len(listed) >= 4
        assert [line for line in listed if not line.endswith((".", "?")) or line.endswith("....")] == []
        assert [line for line in listed if re.search(r"\w\.\.\.$", line)] == []


def test_run_and_analyse(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    bag, report = tmp_path / "bag", tmp_path / "report.json"
    status, said = agv_ncs("run", "config/outages.yaml", "--bag", bag, "--duration", "2", "--seed", "3")
    assert status == 0
    assert f"bag: {bag}: " in said
    assert "everything that was published" in said
    status, said = agv_ncs("analyse", bag, "--json", report)
    assert status == 0
    found = json.loads(report.read_text())
    assert {
        "loss_rate", "n_ul_max", "settle_1cm_steps", "settle_2pct_steps", "overshoot", "damping", "paper_stable",
        "lifted_stable", "bursts_stable",
    } <= found.keys()  # fmt: skip
    assert (found["steps"], found["seed"], found["valid"]) == (400, 3, True)
    assert f"{100.0 * found['loss_rate']:.3g} % lost" in said
    assert str(bag) in said
    picture = Path(re.search(r"picture: (\S+)", said)[1])  # type: ignore[index]
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_the_same_settings_by_option_and_by_set(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    agv_ncs("run", "config/paper.yaml", "--bag", tmp_path / "a", "--duration", "0.5", "--seed", "9")
    agv_ncs("run", "config/paper.yaml", "--bag", tmp_path / "b", "--set", "plant.duration=0.5", "--set", "relay.seed=9")
    a, b = (next((tmp_path / name).glob("*.mcap")).stat().st_size for name in "ab")
    assert a == b


def test_analysis_works_where_there_is_no_ros(start: Callable[..., object], tmp_path: Path) -> None:
    options = ["bags/sample", "--json", str(tmp_path / "a.json"), "--picture", str(tmp_path / "a.png")]
    status, said = start(sys.executable, "-c", WITHOUT_ROS, "analyse", *options).end()  # type: ignore[attr-defined]
    assert status == 0, said
    assert json.loads((tmp_path / "a.json").read_text())["steps"] == 2000


def test_running_where_there_is_no_ros_says_how_to_get_it(start: Callable[..., object]) -> None:
    status, said = start(sys.executable, "-c", WITHOUT_ROS, "run", "config/paper.yaml").end()  # type: ignore[attr-defined]
    assert status == 1
    assert last_line(said).startswith("Error: the loop runs on ROS 2, which is not to be found here")
    assert "pip install 'agv_ncs[ros]'" in said
    assert "Traceback" not in said


def _params(path: Path, controller: str = "", plant: str = "") -> Path:
    path.write_text(
        f"controller:\n  ros__parameters:\n    ky: 1.0\n    {controller}\nplant:\n  ros__parameters:\n"
        f"    clock: lockstep\n    {plant}\n"
    )
    return path


@pytest.mark.parametrize(
    ("controller", "plant", "words"),
    [
        ("kx: 25", "", ["controller.kx", "integer 25", "25.0"]),
        ("kx: fast", "", ["controller.kx", "'fast'"]),
        ("kx: .inf", "", ["controller.kx", "inf", "[0, 1e+06]"]),
        ("kx: .nan", "", ["controller.kx", "nan"]),
        ("kxx: 1.0", "", ["controller.kxx", "kx, ky, ktheta"]),
        ("", "ts: .nan", ["ts", "nan", "[1e-06, 10]"]),
        ("", "ts: -0.005", ["ts", "-0.005", "[1e-06, 10]"]),
        ("", "ts: 0.0", ["ts", "0.0"]),
        ("", "initial_pose: [1.0, 2.0]", ["plant.initial_pose", "3 finite numbers"]),
        ("", "duration: -1.0", ["plant.duration", "-1.0"]),
    ],
)
def test_a_bad_value_in_a_file_is_one_line(
    agv_ncs: AgvNcs, tmp_path: Path, controller: str, plant: str, words: list[str]
) -> None:
    path = _params(tmp_path / "params.yaml", controller, plant)
    status, said = agv_ncs("run", path)
    assert status == 1
    assert last_line(said).startswith("Error: ")
    assert "Traceback" not in said
    for word in (str(path), *words):
        assert word in last_line(said)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (["relay.uplink.model=smoke_signals"], ["relay.uplink.model", "smoke_signals", "bernoulli"]),
        (["relay.uplink.p=1.5"], ["relay.uplink.p", "1.5", "[0, 1]"]),
        (["relay.uplink.p=-0.1"], ["relay.uplink.p", "-0.1", "[0, 1]"]),
        (["error_detector.track=spiral"], ["error_detector.track", "spiral", "circle"]),
        (["error_detector.track=csv"], ["error_detector.track_file"]),
        (["error_detector.track=csv", "error_detector.track_file=no.csv"], ["no.csv", "No such file"]),
        (["controller.kx=inf"], ["controller.kx", "inf"]),
        (["controller.speed=1.0"], ["controller.speed=1.0", "kx"]),
        (["steering.kx=1.0"], ["steering", "controller"]),
        (["controller.kx"], ["node.parameter=value"]),
    ],
)
def test_a_bad_setting_is_one_line(agv_ncs: AgvNcs, settings: list[str], words: list[str]) -> None:
    pytest.importorskip("rclpy", reason="needs ROS 2: pip install '.[ros]'")
    status, said = agv_ncs("run", "config/paper.yaml", *(f"--set={setting}" for setting in settings))
    assert status == 1
    assert "Traceback" not in said
    for word in words:
        assert word in last_line(said)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (None, ["No such file or directory"]),
        ("[1, 2", ["is not YAML"]),
        ("just words", ["no parameters in it"]),
        ("controller: {kx: 1.0}", ["controller", "ros__parameters"]),
    ],
)
def test_a_file_that_is_no_params_file_is_one_line(
    agv_ncs: AgvNcs, tmp_path: Path, content: str | None, words: list[str]
) -> None:
    path = tmp_path / "params.yaml"
    if content is not None:
        path.write_text(content)
    status, said = agv_ncs("run", path)
    assert status == 1
    assert "Traceback" not in said
    for word in (str(path), *words):
        assert word in last_line(said)


# -- analyse ----------------------------------------------------------------------------------------------------------


def test_a_bag_that_is_not_there(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    status, said = agv_ncs("analyse", tmp_path / "none")
    assert status == 1
    assert str(tmp_path / "none") in last_line(said)
    assert "Traceback" not in said


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0\r\n", b"not a bag at all, only words" * 100])
def test_a_corrupt_bag(agv_ncs: AgvNcs, tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "broken.mcap"
    path.write_bytes(content)
    status, said = agv_ncs("analyse", path)
    assert status == 1
    assert str(path) in last_line(said)
    assert "Traceback" not in said


def test_a_bag_without_the_topics(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    from mcap.writer import Writer

    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        channel = writer.register_channel("/chatter", "cdr", schema)
        writer.add_message(channel, 1, b"\0\1\0\0\2\0\0\0a\0", 1)
        writer.finish()  # type: ignore[no-untyped-call]
    status, said = agv_ncs("analyse", path)
    assert status == 1
    assert "no recording of the loop" in last_line(said)
    assert "/agv/pose" in last_line(said)
    assert "/chatter" in last_line(said)


def test_a_bag_that_does_not_carry_its_parameters_needs_a_config(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    """A bag as `ros2 bag record` makes it: the same messages, nothing embedded."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    path = tmp_path / "plain.mcap"
    with next((REPOSITORY / "bags/sample").glob("*.mcap")).open("rb") as source, path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[str, int] = {}
        for schema, channel, message in make_reader(source).iter_messages():
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            writer.add_message(channels[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    status, said = agv_ncs("analyse", path)
    assert (status, "--config" in last_line(said)) == (1, True)
    plain, sample = tmp_path / "plain.json", tmp_path / "sample.json"
    assert agv_ncs("analyse", path, "--config", "config/outages.yaml", "--json", plain)[0] == 0
    picture = ("--picture", tmp_path / "sample.png")
    assert agv_ncs("analyse", "bags/sample", "--json", sample, *picture)[0] == 0
    differing = {"source", "notes"}
    found, expected = (
        {key: value for key, value in json.loads(file.read_text()).items() if key not in differing}
        for file in (plain, sample)
    )
    assert found == expected


def test_json_that_cannot_be_written(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    status, said = agv_ncs(
        "analyse", "bags/sample", "--json", tmp_path / "no" / "a.json", "--picture", tmp_path / "a.png"
    )
    assert status == 1
    assert f"{tmp_path}/no/a.json: cannot be written" in last_line(said)


def test_the_embedded_parameters_are_a_params_file(agv_ncs: AgvNcs, tmp_path: Path) -> None:
    from agv_analysis.bags import read_bag

    text = read_bag(REPOSITORY / "bags/sample").metadata["agv_ncs"]["params"]
    assert yaml.safe_load(text)
    (tmp_path / "params.yaml").write_text(text)
    options = ("--config", tmp_path / "params.yaml", "--picture", tmp_path / "a.png")
    assert agv_ncs("analyse", "bags/sample", *options)[0] == 0
