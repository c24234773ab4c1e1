"""The answer of a command in a frame of at most five lines."""

from __future__ import annotations

from pathlib import Path

import pytest
from rich.console import Console

from agv_analysis.report.table import headline_rows, print_framed, print_table, rows
from agv_analysis.scenario import load_scenario
from agv_analysis.simulation import simulate
from agv_analysis.stability.analysis import analyse

REPO = Path(__file__).resolve().parents[3]


def framed(text: str) -> list[str]:
    """The lines between the borders of the frame that a text begins with."""
    lines = text.splitlines()
    begin = next(i for i, line in enumerate(lines) if line.startswith("╭"))
    end = next(i for i, line in enumerate(lines) if line.startswith("╰"))
    return [line.strip("│").strip() for line in lines[begin + 1 : end]]


def printed(width: int, *headlines: tuple[str, str]) -> list[str]:
    console = Console(width=width, highlight=False)
    with console.capture() as captured:
        print_framed(console, headlines)
    return framed(captured.get())


def test_a_value_that_takes_too_many_lines_is_cut_off_after_a_clause() -> None:
    clauses = [f"the clause of number {number} says what it says" for number in range(12)]
    lines = printed(
        60, ("Verdict", "[bold red]Unstable[/]"), ("Because", "; ".join(clauses)), ("Deviation", "diverges")
    )
    assert len(lines) <= 5
    assert lines[0].split() == ["Verdict", "Unstable"]
    assert lines[-1].split() == ["Deviation", "diverges"]
    because = " ".join(lines[1:-1]).removeprefix("Because").split()
    assert because[-1] == "..."
    whole = " ".join(because[:-1])
    assert "; ".join(clauses).startswith(whole)
    assert whole.endswith("says what it says")


def test_what_fits_into_the_frame_is_left_as_it_is() -> None:
    assert printed(80, ("Verdict", "Stable"), ("Deviation", "at most 1 m, at 2 s")) == [
        "Verdict    Stable",
        "Deviation  at most 1 m, at 2 s",
    ]


@pytest.mark.parametrize("width", [80, 120])
@pytest.mark.parametrize(
    "settings",
    [
        "",
        "controller.v_max=2.0 controller.kx=300.0",
        "controller.kx=300.0",
        "plant.duration=1.0 relay.uplink.p=0.5 relay.uplink.r=0.01",
        "plant.duration=20.0 controller.law=state_feedback relay.uplink.r=0.002",
    ],
)
def test_the_answer_has_at_most_five_lines_and_the_whole_reason_is_below(
    settings: str, width: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(width))
    analysis = analyse(simulate(load_scenario(REPO / "config/outages.yaml", settings.split())))
    print_table(analysis)
    text = capsys.readouterr().out
    assert 3 <= len(framed(text)) <= 5
    assert "".join(analysis.verdict.reason.split()) in "".join(text.split())


def figures_of(*settings: str) -> dict[str, str]:
    """Headlines and figures of a simulated run, by name."""
    analysis = analyse(simulate(load_scenario(str(REPO / "config/outages.yaml"), list(settings))))
    return dict(rows(analysis)) | dict(headline_rows(analysis))


def test_a_run_without_losses_has_no_outages_to_count() -> None:
    found = figures_of("plant.duration=5.0", "relay.uplink.model=perfect")
    assert found["Uplink"] == "no update lost"
    assert found["Longest outage"] == "none"


def test_a_run_that_diverges_has_no_numbers_of_a_hundred_digits() -> None:
    found = figures_of("plant.duration=60.0", "controller.kx=500.0")
    assert found["Deviation"] == found["Speed asked for"] == "diverges"
    assert found["Overshoot"] == "not known"
    assert "without any loss" in found["Because"]
    assert not any("e+" in value or "inf" in value.split() for value in found.values())


def test_a_stable_loop_beside_its_track_says_so_in_the_first_line() -> None:
    """With 0.3 m/s the AGV cuts the corners of a track that is driven at up to 1.5 m/s."""
    assert "m beside the track" in figures_of("controller.v_max=0.3")["Verdict"]
