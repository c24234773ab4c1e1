"""Parameter files: the same values as ROS reads, later over earlier, and one line for whatever is wrong."""

from __future__ import annotations

import random
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from agv_ros.parameters import LoopParameters, ParameterError, group, parameter, parameters_of
from agv_ros.params_file import parse_sections, parse_setting, read_sections, resolve
from agv_ros.ros_yaml import RosYamlError, dump, load, scalar


@dataclass(frozen=True)
class Gear:
    ratio: float = parameter(2.0, "gear ratio", low=0.0, high=10.0)


@dataclass(frozen=True)
class Motor(LoopParameters):
    power: float = parameter(1.0, "power", unit="W", above=0.0)
    poles: int = parameter(4, "number of poles", low=2, high=64)
    maker: str = parameter("", "who made it")
    brake: bool = parameter(False, "has it a brake")
    place: tuple[float, float] = parameter((0.0, 0.0), "where it is", unit="m, m")
    front: Gear = group(Gear)


@dataclass(frozen=True)
class Pump(LoopParameters):
    power: float = parameter(1.0, "power", unit="W", above=0.0)


SCHEMAS: dict[str, type] = {"motor": Motor, "pump": Pump}
KNOWN = {node: parameters_of(schema) for node, schema in SCHEMAS.items()}


def resolved(text: str, *sets: str) -> dict[str, Any]:
    return resolve(SCHEMAS, parse_sections(text, "f.yaml"), sets, "f.yaml")


def refusal(text: str, *sets: str) -> str:
    with pytest.raises(ParameterError) as caught:
        resolved(text, *sets)
    message = str(caught.value)
    assert "\n" not in message
    return message


# -- what a word means -----------------------------------------------------------------------------------------------

WORDS = [
    "25", "25.0", "25.", ".5", "+5", "-7", "1e3", "1.0e3", "1.0e+3", "2E-3", "010", "08", "-0x10", "0x1F", "0b11",
    "0o7", "1_000", "1:30", "inf", "-inf", ".inf", "-.inf", "+.INF", "nan", ".NaN", "infinity", "1e", "1e400", "e3",
    ".", "y", "Y", "n", "yes", "No", "on", "OFF", "true", "True", "TRUE", "tRue", "false", "~", "null", "2024-01-01",
    "2024-13-45", "1.2.3", "map", "9223372036854775807", "9223372036854775808", "-9223372036854775809",
    "99999999999999999999999999999",
]  # fmt: skip


def read_by_ros(folder: Path, monkeypatch: pytest.MonkeyPatch, text: str, name: str = "motor") -> dict[str, Any]:
    """Parameters that a real rclpy node called `name` finds in a params file, by dotted name."""
    rclpy = pytest.importorskip("rclpy", reason="ROS 2's own reader of params files comes with rclpy")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    path = folder / "params.yaml"
    path.write_text(text, encoding="utf-8")
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(path)], domain_id=87)
    try:
        node = rclpy.create_node(name, context=context, automatically_declare_parameters_from_overrides=True)
        values = {found: node.get_parameter(found).value for found in node._parameters}
        node.destroy_node()
    finally:
        context.try_shutdown()
    return {found: value for found, value in values.items() if found not in ROS_OWN}


ROS_OWN = ("use_sim_time", "start_type_description_service")


def same(a: object, b: object) -> bool:
    return type(a) is type(b) and (a == b or (a != a and b != b))


def test_every_word_means_what_it_means_to_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    draw = random.Random(1)
    made = {"".join(draw.choices("0123456789+-.eEnNaAiIfFyYoOtT_", k=draw.randint(1, 6))) for _ in range(3000)}
    words = [*WORDS, *(word for word in sorted(made) if is_plain_word(word))]
    assert len(words) > 2000
    body = "\n".join(f"    p{i}: {word}" for i, word in enumerate(words))
    found = read_by_ros(tmp_path, monkeypatch, f"motor:\n  ros__parameters:\n{body}\n")
    differing = {
        word: (found[f"p{i}"], scalar(word)) for i, word in enumerate(words) if not same(found[f"p{i}"], scalar(word))
    }
    assert not differing


def is_plain_word(word: str) -> bool:
    """Is it a single unquoted scalar to a YAML parser?"""
    try:
        node = yaml.compose(f"a: {word}")
    except yaml.YAMLError:
        return False
    assert isinstance(node, yaml.MappingNode)
    value = node.value[0][1]
    return isinstance(value, yaml.ScalarNode) and value.value == word and value.style is None


def test_structure_means_what_it_means_to_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = """
/**:
  ros__parameters: {all: 1.0, over: 1.0, y: 3, quoted: "25", 'single': 'no'}
motor:
  ros__parameters:
    over: 2.0
    nested: {a: 1.0, b.c: 2.0}
    list: [1e0, 2.0]
    words: [a, "1"]
    block: |-
      1.0
/motor:
  ros__parameters: {slash: 1.0}
"*":
  ros__parameters: {star: 1.0}
/**/motor:
  ros__parameters: {wild: 1.0}
"""
    ours = parse_sections(text, "f.yaml")
    assert {**ours["/**"], **ours["motor"]} == read_by_ros(tmp_path, monkeypatch, text)


@pytest.mark.parametrize("order", [("motor", "/**"), ("/**", "motor")])
def test_the_later_section_wins_as_in_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, order: list[str]) -> None:
    powers = {"motor": 2.0, "/**": 3.0}
    text = "\n".join(f"{node}: {{ros__parameters: {{power: {powers[node]}}}}}" for node in order)
    expected = read_by_ros(tmp_path, monkeypatch, text)["power"]
    assert resolved(text)["motor"].power == expected == powers[order[1]]


def test_every_rclpy_node_has_the_parameters_that_are_let_pass(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert read_by_ros(tmp_path, monkeypatch, "motor: {ros__parameters: {power: 1.0}}") == {"power": 1.0}
    text = "motor: {ros__parameters: {use_sim_time: true, start_type_description_service: false, power: 2.0}}"
    assert resolved(text)["motor"].power == 2.0
    assert resolved("/**: {ros__parameters: {use_sim_time: true, qos_overrides: {/a: {b: {depth: 5}}}}}")


trees = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(-(2**63), 2**63 - 1),
        st.floats(allow_nan=False),
        st.text(max_size=8),
        st.sampled_from(WORDS),
    ),
    lambda children: st.one_of(
        st.lists(children, max_size=3),
        st.dictionaries(st.one_of(st.text(max_size=5), st.sampled_from(WORDS)), children),
    ),
    max_leaves=8,
)


@settings(deadline=None, derandomize=True)
@given(trees)
def test_what_is_dumped_is_read_back(tree: object) -> None:
    assert repr(load(dump(tree))) == repr(tree)


@settings(deadline=None, derandomize=True)
@given(st.dictionaries(st.from_regex("[a-z]{1,5}", fullmatch=True), st.text(max_size=8), min_size=1))
def test_dumped_strings_are_strings_to_plain_yaml_too(texts: dict[str, str]) -> None:
    assert yaml.safe_load(dump(texts)) == texts


@settings(deadline=None, derandomize=True, max_examples=300)
@given(st.one_of(st.text(max_size=60), st.text(alphabet="a:b -[]{}&*!%|>\n'\"#,?1.e\\U0x", max_size=60)))
def test_no_text_makes_another_error(text: str) -> None:
    with suppress(ParameterError):
        parse_sections(text, "f.yaml")


@pytest.mark.parametrize(
    "text",
    ["[" * 5000, '"\\U00ffffff"', "!!timestamp x", "!!int x", "!!binary x", "%YAML 9.9\n---\na: 1", "a: 1\n---\nb: 2"],
)
def test_texts_that_upset_parsers(text: str) -> None:
    with pytest.raises(ParameterError, match=r"^f\.yaml: "):
        parse_sections(text, "f.yaml")


def test_aliases_are_refused_before_they_multiply() -> None:
    lines = ["a0: &a0 [x, x]"] + [f"a{i}: &a{i} [*a{i - 1}, *a{i - 1}, *a{i - 1}]" for i in range(1, 40)]
    with pytest.raises(RosYamlError, match="aliases"):
        load("\n".join(lines))


# -- sections --------------------------------------------------------------------------------------------------------


def test_nested_and_dotted_names_are_one() -> None:
    nested = resolved("motor:\n  ros__parameters:\n    front:\n      ratio: 3.0\n")
    dotted = resolved("motor:\n  ros__parameters:\n    front.ratio: 3.0\n")
    assert nested["motor"].front.ratio == dotted["motor"].front.ratio == 3.0


@pytest.mark.parametrize(
    "title", ["motor", "/motor", "/hall/motor", "/*/motor", "/**/motor", "hall:\n  motor", "/hall:\n  /motor"]
)
def test_a_section_is_found_in_whatever_namespace(title: str) -> None:
    indent = "    " if "\n" in title else "  "
    assert resolved(f"{title}:\n{indent}ros__parameters: {{power: 3.0}}")["motor"].power == 3.0


def test_namespaces_as_levels_are_those_of_ros(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rclpy = pytest.importorskip("rclpy", reason="ROS 2's own reader of params files comes with rclpy")
    text = "hall:\n  motor:\n    ros__parameters: {power: 3.0}\n"
    path = tmp_path / "params.yaml"
    path.write_text(text, encoding="utf-8")
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    context = rclpy.Context()
    rclpy.init(context=context, args=["--ros-args", "--params-file", str(path)], domain_id=87)
    try:
        node = rclpy.create_node("motor", namespace="hall", context=context)
        assert node.declare_parameter("power", 1.0).value == resolved(text)["motor"].power == 3.0
        node.destroy_node()
    finally:
        context.try_shutdown()


def test_two_loops_in_one_file_are_not_mixed() -> None:
    text = "a: {motor: {ros__parameters: {power: 1.0}}}\nb: {motor: {ros__parameters: {power: 2.0}}}"
    assert refusal(text) == "f.yaml: sections a/motor and b/motor give motor.power two values"


def test_what_is_for_all_nodes_reaches_those_that_have_it() -> None:
    found = resolved("/**: {ros__parameters: {power: 3.0, poles: 8}}")
    assert (found["motor"].power, found["motor"].poles, found["pump"].power) == (3.0, 8, 3.0)


def test_what_all_nodes_share_is_set_for_all() -> None:
    found = resolved("motor: {ros__parameters: {ts: 0.01}}")
    assert found["motor"].ts == found["pump"].ts == 0.01
    found = resolved("motor: {ros__parameters: {ts: 0.01}}", "pump.ts=0.02", "pump.start_time=5")
    assert found["motor"].ts == found["pump"].ts == 0.02
    assert found["motor"].start_time == 5.0


def test_two_values_of_what_is_shared_are_refused() -> None:
    text = "motor: {ros__parameters: {ts: 0.01}}\npump: {ros__parameters: {ts: 0.02}}"
    assert refusal(text) == "f.yaml: motor.ts is 0.01 and pump.ts is 0.02: all nodes must have the same"
    assert "motor.ts is 0.1 and pump.ts is 0.2" in refusal(
        "motor: {ros__parameters: {}}", "motor.ts=0.1", "pump.ts=0.2"
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("motor: {ros__parameters: {power: 5}}", "f.yaml: motor.power is a double, got the integer 5: write 5.0"),
        ("motor: {ros__parameters: {power: -5.0}}", "f.yaml: motor.power must be > 0 and finite, got -5.0"),
        ("motor: {ros__parameters: {power: .nan}}", "f.yaml: motor.power must be > 0 and finite, got nan"),
        ("motor: {ros__parameters: {power: .inf}}", "f.yaml: motor.power must be > 0 and finite, got inf"),
        ("motor: {ros__parameters: {power: much}}", "f.yaml: motor.power is a double, got 'much'"),
        ("motor: {ros__parameters: {power: }}", "f.yaml: motor.power is a double, got None"),
        ("motor: {ros__parameters: {poles: 4.0}}", "f.yaml: motor.poles is an integer, got 4.0"),
        ("motor: {ros__parameters: {poles: true}}", "f.yaml: motor.poles is an integer, got True"),
        ("motor: {ros__parameters: {poles: 1}}", "f.yaml: motor.poles must be in [2, 64], got 1"),
        ("motor: {ros__parameters: {maker: 5}}", "f.yaml: motor.maker is a string, got 5"),
        ("motor: {ros__parameters: {brake: 1}}", "f.yaml: motor.brake is true or false, got 1"),
        ("motor: {ros__parameters: {place: 1.0}}", "f.yaml: motor.place is a list of 2 doubles, got 1.0"),
        ("motor: {ros__parameters: {place: [1.0]}}", "f.yaml: motor.place must be 2 finite numbers, got 1: [1.0]"),
        ("motor: {ros__parameters: {place: [1.0, 2]}}", "the integer 2: write 2.0"),
        ("motor: {ros__parameters: {front: {ratio: 11.0}}}", "f.yaml: motor.front.ratio must be in [0, 10], got 11.0"),
        ("motor: {ros__parameters: {pover: 1.0}}", "f.yaml: unknown parameter motor.pover: motor has ts, start_time,"),
        ("/**: {ros__parameters: {pover: 1.0}}", "f.yaml: section /**: no node has a parameter 'pover'"),
        ("motor: {ros__parameters: {power: 1.0, power: 2.0}}", "f.yaml: line 1: 'power' is there a second time"),
        ("motor: {ros__parameters: {[a]: 2.0}}", "f.yaml: line 1: a name must be a single word"),
        ("motor: 5", "f.yaml: section 'motor' has no mapping 'ros__parameters' in it"),
        ("motor: {power: 5.0}", "f.yaml: section 'motor/power' has no mapping 'ros__parameters' in it"),
        ("motor: {ros__parameters: [1]}", "f.yaml: section 'motor' has no mapping 'ros__parameters' in it"),
        ("", "f.yaml: no parameters in it"),
        ("- a", "f.yaml: no parameters in it"),
        ("motor: [", "f.yaml: is not YAML"),
        ("motor: a: b", "f.yaml: is not YAML"),
        ("motor: \x00", "f.yaml: is not YAML"),
    ],
)
def test_refusals_name_file_parameter_found_and_allowed(text: str, words: str) -> None:
    assert words in refusal(text)


# -- files -----------------------------------------------------------------------------------------------------------


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    missing, latin = tmp_path / "none.yaml", tmp_path / "latin.yaml"
    latin.write_bytes("# caf\xe9".encode("latin-1"))
    for path, words in ((missing, "No such file"), (tmp_path, "Is a directory"), (latin, "is not UTF-8 text")):
        with pytest.raises(ParameterError, match=words) as caught:
            read_sections(str(path))
        assert str(caught.value).startswith(f"{path}: ")
        assert "\n" not in str(caught.value)


def test_a_file_with_a_byte_order_mark_is_read(tmp_path: Path) -> None:
    path = tmp_path / "bom.yaml"
    path.write_bytes(b"\xef\xbb\xbfmotor: {ros__parameters: {power: 3.0}}")
    assert read_sections(str(path)) == {"motor": {"power": 3.0}}


# -- settings --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("motor.power=250", 250.0),
        ("motor.power=1e3", 1000.0),
        ("motor.power= 2.5", 2.5),
        ("motor.poles=8", 8),
        ("motor.maker=25", "25"),
        ("motor.maker=a=b", "a=b"),
        ("motor.maker=", ""),
        ("motor.brake=true", True),
        ("motor.place=[1, 2.5]", (1.0, 2.5)),
        ("motor.front.ratio=3", 3.0),
    ],
)
def test_settings_mean_what_a_person_types(text: str, value: object) -> None:
    node, name, found = parse_setting(text, KNOWN)
    assert (node, f"{node}.{name}") == ("motor", text.partition("=")[0])
    assert same(found, value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("motor.power", "expected node.parameter=value, as in controller.kx=25.0"),
        ("power=5", "expected node.parameter=value"),
        ("fan.power=5", "unknown node 'fan', must be one of motor, pump"),
        ("motor.pover=5", "motor has no parameter 'pover', it has ts, "),
        ("motor.power=-5", "motor.power must be > 0 and finite, got -5.0"),
        ("motor.power=nan", "got nan"),
        ("motor.power=", "motor.power is a double, got None"),
        ("motor.power=true", "motor.power is a double, got True"),
        ("motor.poles=8.0", "motor.poles is an integer, got 8.0"),
        ("motor.place=[1, x]", "motor.place must be 2 finite numbers, got [1.0, 'x']"),
        ("motor.place=[1", "is not YAML"),
    ],
)
def test_settings_that_are_refused(text: str, words: str) -> None:
    message = refusal("motor: {ros__parameters: {}}", text)
    assert message.startswith(f"--set {text}: ")
    assert words in message


def test_settings_win_over_the_file_and_later_ones_over_earlier() -> None:
    text = "motor: {ros__parameters: {power: 2.0}}"
    assert resolved(text, "motor.power=3")["motor"].power == 3.0
    assert resolved(text, "motor.power=3", "motor.power=4")["motor"].power == 4.0


@settings(deadline=None, derandomize=True)
@given(
    st.floats(0.001, 1e300), st.integers(2, 64), st.booleans(), st.tuples(st.floats(-1e9, 1e9), st.floats(-1e9, 1e9))
)
def test_a_file_and_settings_say_the_same(power: float, poles: int, brake: bool, place: tuple[float, float]) -> None:
    values = {"power": power, "poles": poles, "brake": brake, "place": list(place)}
    by_file = resolved(dump({"motor": {"ros__parameters": values}}))
    by_settings = resolved("motor: {ros__parameters: {}}", *(f"motor.{name}={value}" for name, value in values.items()))
    assert by_file == by_settings
    assert by_file["motor"] == Motor(power=power, poles=poles, brake=brake, place=place)
