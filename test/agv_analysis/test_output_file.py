"""Files that commands write: links in their place, and files of others."""

from __future__ import annotations

import importlib
import shutil
from collections.abc import Callable
from pathlib import Path

import click
import pytest

from agv_analysis.cli import COMMANDS
from agv_analysis.commands import OutputFile
from agv_analysis.link import link_probe
from agv_analysis.output_file import is_ours, output_file
from agv_ros.errors import UserError

CONFIG = Path(__file__).parents[2] / "config"
SAMPLE = Path(__file__).parents[2] / "bags/sample"


def test_a_link_is_followed_within_its_directory_only(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    inside, outside, dangling = (tmp_path / "folder" / name for name in ("inside", "outside", "dangling"))
    inside.symlink_to("file")
    outside.symlink_to("../file")
    dangling.symlink_to("/nowhere/at/all")
    assert output_file(inside) == inside
    for path in (outside, dangling):
        with pytest.raises(UserError, match="out of its directory"):
            output_file(path)
    (tmp_path / "link").symlink_to("folder")  # the directory itself may be a link: who names it knows
    assert output_file(tmp_path / "link" / "file") == tmp_path / "link" / "file"
    assert output_file("/dev/stdout") == Path("/dev/stdout")


def test_the_picture_of_a_bag_is_not_drawn_through_a_link(
    agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    (tmp_path / "bag").mkdir()
    shutil.copy(next(SAMPLE.glob("*.mcap")), tmp_path / "bag/bag_0.mcap")
    precious = tmp_path / "precious"
    precious.write_text("mine")
    (tmp_path / "bag/overview.png").symlink_to(precious)
    status, said = agv_ncs("analyse", tmp_path / "bag")
    assert (status, precious.read_text(), "Traceback" in said) == (1, "mine", False)
    assert "overview.png: is a link to" in " ".join(said.split())


OUTPUTS: dict[str, tuple[str, ...]] = {
    "simulate": ("--csv", "r.csv", "--json", "r.json"),
    "channel": ("--csv", "c.csv", "--json", "c.json", "--picture", "c.pdf"),
    "stability": ("--map", "kx,ts", "--points", "2", "--csv", "m.csv", "--picture", "m.svg", "--report", "m.html"),
    "require": ("--table", "t.md", "--json", "t.json"),
    "analyse": ("--picture", "a.PNG"),
}
"""Each kind of file with a mark."""


@pytest.mark.parametrize("command", OUTPUTS)
def test_a_command_replaces_what_it_wrote_and_keeps_what_others_wrote(
    command: str, agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    places = [tmp_path / word if "." in word else word for word in OUTPUTS[command]]
    about = (SAMPLE,) if command == "analyse" else (CONFIG / "outages.yaml", "--set", "plant.duration=2.0")
    asked = (command, *about, *places)
    assert agv_ncs(*asked)[0] == 0
    written = [path for path in tmp_path.rglob("*.*") if path.is_file()]
    assert {path.name for path in written} >= {word for word in OUTPUTS[command] if "." in word}
    for path in written:
        path.write_bytes(path.read_bytes() + b" \n")
    status, said = agv_ncs(*asked)
    assert status == 0, said
    assert not [path for path in written if path.read_bytes().endswith(b" \n")]
    for path in (one for one in places if isinstance(one, Path) and one.suffix):
        path.write_text("mine")
        status, said = agv_ncs(*asked)
        assert (status, path.read_text(), "Traceback" in said) == (1, "mine", False)
        assert f"{path.name}: was not written by agv-ncs and is kept" in " ".join(said.split())
        path.unlink()
    path.write_text("mine")
    assert agv_ncs(*asked, "--force")[0] == 0
    assert path.read_bytes() != b"mine"


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("params.yaml", (CONFIG / "paper.yaml").read_bytes()),
        ("bag.mcap", next(SAMPLE.glob("*.mcap")).read_bytes()),
        ("other.json", b'{"made_by": "agv_ncs", "inside": {"written_by": "agv_ncs"}}'),
        ("list.json", b'[{"written_by": "agv_ncs"}]'),
        ("page.html", b'<!DOCTYPE html><meta name="generator" content="Hugo"><p>agv_ncs'),
        ("photo.png", b"\x89PNG\r\n\x1a\n" + bytes(5000) + b"tEXtSoftware\0agv_ncs"),
        ("drawing.svg", b"<?xml version='1.0'?><svg><title>agv_ncs</title></svg>"),
        ("paper.pdf", b"%PDF-1.4 /Creator (TeX) agv_ncs"),
        ("table.csv", b"k,lost,why\n0,1,rain\n"),
        ("ping.csv", b"time,seq,rtt\n"),
        ("notes.md", b"written by agv_ncs\n"),
        ("notes.yaml", b"plant: {}  # written by agv_ncs\n"),
        ("binary", bytes(range(256)) * 1000),
    ],
)
def test_what_is_no_earlier_output_is_kept(name: str, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(UserError, match=f"{name}: was not written by agv-ncs .* give --force"):
        output_file(path)
    path.write_bytes(b"")  # as mktemp makes it: nothing is lost
    assert output_file(path) == path


def test_columns_that_a_trace_begins_with_are_known(tmp_path: Path) -> None:
    (tmp_path / "link.csv").write_text(",".join(link_probe.COLUMNS) + "\n0.0\n")
    assert is_ours(tmp_path / "link.csv")
    assert not is_ours(tmp_path / "none.csv")


WRITTEN = ("json_file", "csv_file", "picture", "report", "trace", "table", "outages", "params_file")


def test_each_command_that_writes_a_file_has_force() -> None:
    groups = [importlib.import_module(f"agv_analysis.commands.{name}").command for name in COMMANDS]
    commands = [one for group in groups for one in getattr(group, "commands", {"": group}).values()]
    writing = [one for one in commands if any(isinstance(param.type, OutputFile) for param in one.params)]
    assert len(writing) == 13
    for one in commands:
        for param in one.params:
            assert param.name not in WRITTEN or isinstance(param.type, (OutputFile, click.types.BoolParamType))
        assert one not in writing or any("--force" in param.opts for param in one.params), one.name


def test_the_paper_is_not_reproduced_into_a_directory_of_others(
    agv_ncs: Callable[..., tuple[int, str]], tmp_path: Path
) -> None:
    (tmp_path / "paper.tex").write_text("mine")
    status, said = agv_ncs("reproduce", "--out", tmp_path)
    assert status == 1
    assert "is not empty and contains no earlier result: name another directory, or give --force" in " ".join(
        said.split()
    )
    assert [path.name for path in tmp_path.iterdir()] == ["paper.tex"]
