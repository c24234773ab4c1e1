"""An analysis, and the margins of a scenario, as short tables."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from agv_analysis.link.channel_fit import Estimate
from agv_analysis.metrics.convergence import Convergence
from agv_analysis.metrics.deviation import DIVERGED, Deviation, Peak
from agv_analysis.metrics.distance_text import DIVERGES, at_most, metres, speed_text, three_digits
from agv_analysis.metrics.duration_text import outage_text
from agv_analysis.metrics.last_excursion import LastExcursion
from agv_analysis.metrics.outages import LinkOutages, loss_causes
from agv_analysis.report.verdict_sentence import by_what, in_short
from agv_analysis.scenario import Scenario
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Analysis, Observations
from agv_analysis.stability.margins import margins
from agv_analysis.stability.verdict import BOUNDED, GREEN, UNDECIDED, UNKNOWN
from agv_ros.counted import counted

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

_YELLOW = (BOUNDED, UNDECIDED, UNKNOWN)


def colour_of(word: str) -> str:
    """Colour of a verdict's word, in rich's markup."""
    return "green" if word in GREEN else "yellow" if word in _YELLOW else "red"


_NOT_JUDGED = "not judged: messages are missing that no channel lost"


def print_table(analysis: Observations) -> None:
    """Print the verdict in a frame, then the figures in groups, disagreements between the criteria, and notes."""
    from rich.console import Console
    from rich.markup import escape

    console = Console(highlight=False)
    for topic, count in analysis.run.unexplained.items():
        what = "it" if count == 1 else "them"
        console.print(f"[bold red]Invalid:[/] {_missing(escape(topic), count)}, and no channel lost {what}.")
    print_framed(console, headline_rows(analysis))
    print_groups(console, grouped_rows(analysis))
    for sentence in _disagreements(analysis):
        console.print(f"[bold yellow]They disagree:[/] {sentence}.")
    for note in analysis.run.notes:
        console.print(f"[dim]Note: {escape(note)}.[/]")


def print_framed(console: Console, headlines: Iterable[tuple[str, str]]) -> None:
    """Print names and values, text with rich's markup, in a frame: what a command answers first.

    It has at most five lines. A longer value is cut off after a clause; the whole is the business of a table below.
    """
    from rich.panel import Panel
    from rich.table import Table

    frame = Table.grid(padding=(0, 2))
    frame.add_column(style="bold")
    for name, value in _shortened(console, list(headlines)):
        frame.add_row(name, value)
    console.print(Panel(frame, expand=False))


def _shortened(console: Console, headlines: Sequence[tuple[str, str]]) -> list[tuple[str, Text]]:
    """The headlines, the longest of them cut off after a clause until all fit into the lines of a frame."""
    from rich.text import Text

    width = console.width - _FRAME_WIDTH - max((len(name) for name, _ in headlines), default=0)
    found = [(name, Text.from_markup(value)) for name, value in headlines]

    def lines(text: Text) -> int:
        return len(text.wrap(console, max(width, 1)))

    while sum(lines(text) for _, text in found) > _FRAME_LINES:
        longest = max(range(len(found)), key=lambda i: lines(found[i][1]))
        name, text = found[longest]
        end = max((clause.start() for clause in _CLAUSE.finditer(text.plain.removesuffix(_CUT))), default=0)
        if end == 0:
            break  # a narrow terminal: no clause ends early enough
        shorter = text[:end]
        shorter.append(_CUT)
        found[longest] = name, shorter
    return found


_FRAME_LINES = 5
"""Most lines of a frame."""

_FRAME_WIDTH = 6
"""What a frame's border and the space between its columns take [characters]."""

_CLAUSE = re.compile(r"[;:,]\s|\s\(")
"""Where a clause of a value ends."""

_CUT = " ..."
"""Stands for the clauses that have been cut off."""


def print_groups(console: Console, groups: Iterable[tuple[str, Iterable[tuple[str, str]]]]) -> None:
    """Print names and values, text with rich's markup, in one table under the title of each group."""
    from rich.padding import Padding
    from rich.table import Table

    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column()
    for title, group in groups:
        table.add_row(f"[dim]{title}[/]")
        for name, value in group:
            table.add_row(Padding(name, (0, 0, 0, 2)), value)
    console.print(table)


def print_side_by_side(analyses: Mapping[str, Observations]) -> None:
    """Print the figures of several runs, a column for each under its name, then its warnings and notes."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    table = Table("", *analyses, box=None, pad_edge=False, header_style="bold")
    found = [dict(rows(analysis)) for analysis in analyses.values()]
    for name in dict.fromkeys(name for figures in found for name in figures):
        table.add_row(f"[bold]{name}[/]", *(figures.get(name, "-") for figures in found))
    for title, analysis in analyses.items():
        for topic, count in analysis.run.unexplained.items():
            console.print(f"[bold red]{title} is invalid:[/] {_missing(escape(topic), count)}.")
    console.print(table)
    for title, analysis in analyses.items():
        for sentence in (*_disagreements(analysis), *analysis.run.notes):
            console.print(f"[dim]{title}: {escape(sentence)}.[/]")


def rows(analysis: Observations) -> Iterator[tuple[str, str]]:
    """Name and value of each figure, as text with rich's markup."""
    for _, group in grouped_rows(analysis):
        yield from group


def headline_rows(analysis: Observations) -> Iterator[tuple[str, str]]:
    """The verdict, how far the AGV strays and how much more it can take, each in a short line with rich's markup."""
    from rich.markup import escape

    if not isinstance(analysis, Analysis):
        yield "Verdict", f"[bold yellow]none[/]: {in_short(analysis)}"
    elif not analysis.run.unexplained:  # of one that proves nothing this is said before, and it is not judged
        verdict, said = analysis.verdict, in_short(analysis)
        yield "Verdict", f"[bold {colour_of(verdict.word)}]{said[0].upper()}{said[1:]}[/]"
        if verdict.word not in GREEN:
            yield "Because", escape(verdict.reason)
    yield "Deviation", _deviation_in_short(analysis.deviation)
    if isinstance(analysis, Analysis) and not analysis.run.unexplained and analysis.verdict.word in GREEN:
        yield "Margin", escape(analysis.verdict.margin)


def _deviation_in_short(found: Deviation) -> str:
    """The largest deviation with its outage."""
    if not found.worst:
        return metres(found.largest) if found.is_diverged else f"{at_most(found.largest)}, RMS {metres(found.rms)}"
    worst = found.worst[0]
    after = "" if worst.outage is None else f", after an outage of {counted(worst.outage.slots, 'slot')}"
    return f"{at_most(worst.distance)}, at {worst.seconds:g} s{after}"


def grouped_rows(analysis: Observations) -> Iterator[tuple[str, list[tuple[str, str]]]]:
    """The figures in groups: title, and name and value of each."""
    yield "Link", list(_link_rows(analysis))
    yield (
        "Motion",
        [*convergence_rows(analysis.convergence, 1e3 * analysis.run.ts), *deviation_rows(analysis.deviation)],
    )
    if analysis.run.unexplained:
        yield "Criteria", [("Stability", _NOT_JUDGED)]
    elif isinstance(analysis, Analysis):
        yield "Criteria", list(_criteria(analysis))
    else:
        yield "Criteria", [("Stability", f"not judged: {GAINS_UNKNOWN}")]


def _link_rows(analysis: Observations) -> Iterator[tuple[str, str]]:
    """What the radio did."""
    run, up = analysis.run, analysis.outages.uplink
    ms = 1e3 * run.ts
    seed = f", seed {run.scenario.relay.seed}" if run.seed_known else ""
    yield "Run", f"{counted(len(run), 'step')} of {ms:g} ms{seed}"
    yield "Uplink", _losses(up)
    if len(causes := loss_causes(run.uplink)) > 1:
        yield "Lost by", ", ".join(f"{cause} ({count})" for cause, count in causes.items())
    yield (
        "Longest outage",
        f"{counted(up.longest, 'slot')} ({outage_text(up.longest * run.ts)})" if up.count else "none",
    )
    yield (
        "Age of information",
        (
            f"n_ul: mean {up.age.mean:.2f}, p99 {up.age.p99}, at most {counted(up.age.max, 'step')} "
            f"({outage_text(up.age.max * run.ts)})"
        ),
    )
    acted = analysis.outages.command_age
    if acted is not None:
        yield (
            "Age by receive time",
            f"of the pose behind the command that acted: mean {acted.mean:.2f}, p99 {acted.p99}, at most {acted.max} "
            f"steps ({outage_text(acted.max * run.ts)})",
        )
    down = analysis.outages.downlink
    if down.lost or down.age.max:
        yield (
            "Downlink",
            f"{100.0 * down.loss_rate:.3g} % lost, command at most {counted(down.age.max, 'step')} "
            f"({outage_text(down.age.max * run.ts)}) old",
        )
    yield "Fitted channel", _fit(analysis)


def _losses(up: LinkOutages) -> str:
    """How many updates were lost, in how many outages of which length."""
    if not up.count:
        return "no update lost"
    on_average = " on average" if up.count > 1 else ""
    outages = f"{counted(up.count, 'outage')} of {counted(up.mean_burst, 'slot')}{on_average}"
    return f"{100.0 * up.loss_rate:.3g} % lost, in {outages}"


def _missing(topic: str, count: int) -> str:
    """How many messages of a topic are not there."""
    return f"{counted(count, 'message')} of {topic} {'is' if count == 1 else 'are'} missing"


def _disagreements(analysis: Observations) -> list[str]:
    """Sentences on criteria that disagree; none of a recording that proves nothing."""
    return [] if analysis.run.unexplained else analysis.disagreements()


def convergence_rows(found: Convergence, ms: float) -> Iterator[tuple[str, str]]:
    """What becomes of the initial error, and how far away the AGV was; `ms` is the sampling period."""
    from rich.markup import escape

    first = found.initial
    bands = {"1 cm": first.settle_1cm_steps, "2 %": first.settle_2pct_steps}
    seen = [
        f"{counted(steps, 'step')} ({steps * ms / 1e3:g} s) to {band}"
        for band, steps in bands.items()
        if steps is not None
    ]
    seen += [f"not to {band}" for band, steps in bands.items() if steps is None and seen]
    yield "Settling", "; ".join(filter(None, (", ".join(seen), escape(first.reason))))
    yield "Overshoot", _overshoot(found.overshoot)
    yield "Damping of the speed", found.damping or "the run cannot tell"
    yield "Last excursion above 1 cm", _excursion(found.excursion)
    yield "Error", _error(found)


def _overshoot(share: float | None) -> str:
    if share is None or not share <= DIVERGED:
        return "not known"
    if share >= _MANY_TIMES:
        return f"{three_digits(share)} times the initial error"
    return "none" if share < _NO_OVERSHOOT else f"{100.0 * share:.3g} % of the initial error"


_MANY_TIMES, _NO_OVERSHOOT = 10.0, 1e-4
"""Overshoots from which on per cent say little, and below which there is none to speak of."""


def deviation_rows(found: Deviation) -> Iterator[tuple[str, str]]:
    """How far the AGV was from its reference, after which outages, and what the controller asked for."""
    yield "Deviation", deviation_sizes(found)
    if found.worst:
        yield "Largest deviations", "; ".join(_peak(peak) for peak in found.worst)
    if np.isfinite(found.speed):
        yield "Speed asked for", _asked(found)


def _asked(found: Deviation) -> str:
    speed, turn_rate = speed_text(found.speed), f"{three_digits(found.turn_rate)} rad/s"
    return speed if speed == DIVERGES else f"at most {speed}, turning at {turn_rate}"


def deviation_sizes(found: Deviation) -> str:
    """How large a deviation is, and of which part of the run."""
    if found.is_diverged:
        return metres(found.largest)
    of = found.reason or "after the initial error has settled"
    return f"{at_most(found.largest)}, 99 % of the time below {metres(found.p99)}, RMS {metres(found.rms)} ({of})"


def _peak(peak: Peak) -> str:
    cause = "no outage" if peak.outage is None else f"{peak.outage.link} outage of {counted(peak.outage.slots, 'slot')}"
    return f"{metres(peak.distance)} at {peak.seconds:g} s ({cause})"


def _excursion(found: LastExcursion | None) -> str:
    if found is None:
        return "none"
    cause = "of the initial error" if found.is_initial_error else "not after an outage"
    if found.after is not None:
        cause = f"after an outage of {counted(found.after, 'slot')}"
    when = f"{found.seconds:g} s" if found.is_over else f"lasts when the run ends, at {found.seconds:g} s"
    return f"{when}, {cause}"


def _error(found: Convergence) -> str:
    """The error at the start and at the end, and the largest one where that is neither."""
    initial, peak, final = found.position.initial, found.position.peak, found.position.final
    if not peak <= DIVERGED:
        return f"{metres(initial)} at the start, then diverges"
    said = [f"{metres(initial)} at the start"]
    if peak > max(initial, final):
        said.append(f"at most {metres(peak)}")
    return ", ".join([*said, f"{metres(final)} at the end"])


def _criteria(analysis: Analysis) -> Iterator[tuple[str, str]]:
    from rich.markup import escape

    for found in analysis.judgements.values():
        if found.why:
            yield found.label, _judged(found.stable, escape(found.why))
    verdict = analysis.verdict
    yield "Decided by", by_what(verdict.criterion)
    if verdict.word in GREEN:
        yield "Margin", escape(verdict.margin)
    yield "Because", escape(verdict.reason)
    for note in analysis.nominal_notes:
        yield "Loss-free motion", escape(note)


def _fit(analysis: Observations) -> str:
    fit = analysis.fit
    if fit.model == "perfect":
        return "perfect"
    if fit.model == "bernoulli" or fit.p is None or fit.r is None:
        return f"Bernoulli, p {_interval(fit.loss_rate)}"
    return f"Gilbert-Elliott, p {_interval(fit.p)}, r {_interval(fit.r)}"


def _interval(estimate: Estimate) -> str:
    return f"{_probability(estimate.value)} ({_probability(estimate.low)} .. {_probability(estimate.high)})"


def _probability(p: float) -> str:
    return f"{p:.4g}" if 0.999 < p < 1.0 else f"{p:.3g}"


def _judged(stable: bool | None, why: str) -> str:
    if stable is None:
        return f"[yellow]undecided[/] ({why})"
    return f"[green]stable[/] ({why})" if stable else f"[red]unstable[/] ({why})"


def margin_rows(scenario: Scenario) -> Iterator[tuple[str, str]]:
    """Name and value of each margin of a scenario over its track, and what none of them knows of, as plain text."""
    found = margins(scenario)
    yield from found.rows()
    for note in found.notes:
        yield "Loss-free motion", note
    if found.left_out:
        yield "Left out of all of these", ", ".join(found.left_out)
