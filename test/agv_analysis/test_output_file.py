"""Links in the place of files that commands write."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from agv_analysis.output_file import output_file
from agv_ros.errors import UserError

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
