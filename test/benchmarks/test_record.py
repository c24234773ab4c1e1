"""Figures of a bench in a file: what is kept with them, and which changes count as such."""

from __future__ import annotations

import json
import os
from pathlib import Path

import click
import pytest

from benchmarks.comparison import Comparison
from benchmarks.record import changes, read_record, write_record


def rounds(*ratios: float, what: str = "loop") -> list[list[Comparison]]:
    """Rounds of one comparison with these ratios."""
    return [[Comparison(what, ratio * 100.0, "echo", 100.0, "steps/s", 0.5)] for ratio in ratios]


@pytest.fixture
def record(tmp_path: Path) -> Path:
    write_record(tmp_path / "before.json", {"lockstep": rounds(0.40, 0.42, 0.44)})
    return tmp_path / "before.json"


def test_a_record_says_where_and_of_what_its_figures_are(record: Path) -> None:
    said = json.loads(record.read_text())
    assert said["machine"]["cores"] == len(os.sched_getaffinity(0))
    assert said["machine"]["kernel"] == os.uname().release
    assert said["machine"]["memory"] == os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    assert said["versions"]["numpy"]
    (row,) = said["subjects"]["lockstep"]
    assert (row["ours"], row["peer"]) == ([40.0, 42.0, 44.0], [100.0, 100.0, 100.0])
    assert row["ratios"] == pytest.approx([0.40, 0.42, 0.44])


@pytest.mark.parametrize(
    ("now", "word"),
    [
        ((0.43, 0.47, 0.50), None),  # the ranges overlap
        ((0.50, 0.52, 0.54), "better"),
        ((0.30, 0.32, 0.34), "worse"),
        ((0.4405, 0.4405, 0.4405), None),  # apart, and too little of a change
        ((0.50,), "unknown"),  # one round has no range
    ],
)
def test_a_change_is_named_if_it_is_beyond_noise(record: Path, now: tuple[float, ...], word: str | None) -> None:
    *named, last = changes(read_record(record), {"lockstep": rounds(*now)})
    assert [line.split()[0] for line in named] == ([] if word is None else [word])
    assert last.startswith(f"{int(word in ('better', 'worse'))} of {int(word != 'unknown')} ratios changed")


def test_what_is_new_or_gone_is_named(record: Path) -> None:
    new, gone, _ = changes(read_record(record), {"lockstep": rounds(0.4, 0.4, what="loop of eight")})
    assert new.startswith("new      lockstep: loop of eight against echo")
    assert gone == "gone     lockstep: loop against echo"


def test_another_machine_is_named(record: Path) -> None:
    said = json.loads(record.read_text())
    said["machine"]["cores"] = 4096
    record.write_text(json.dumps(said))
    first, *_ = changes(read_record(record), {"lockstep": rounds(0.41, 0.42, 0.43)})
    assert first.startswith("another machine: cores 4096, now ")


@pytest.mark.parametrize("text", ["no figures", "[1, 2]", '{"format": 0, "subjects": {}}'])
def test_another_file_is_refused_by_name(tmp_path: Path, text: str) -> None:
    (tmp_path / "other.json").write_text(text)
    with pytest.raises(click.ClickException, match=r"other\.json"):
        read_record(tmp_path / "other.json")
