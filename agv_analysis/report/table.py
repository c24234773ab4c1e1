"""An analysis as a short table on the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from agv_analysis.link.channel_fit import Estimate
from agv_analysis.metrics.outages import loss_causes
from agv_analysis.stability.analysis import GAINS_UNKNOWN, Analysis, Observations


def print_table(analysis: Observations) -> None:
    """Print the figures, then one line for each disagreement between the criteria, then the notes."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    table = Table(box=None, show_header=False, pad_edge=False)
    table.add_column(style="bold")
    table.add_column()
    for name, value in rows(analysis):
        table.add_row(name, value)
    console.print(table)
    for sentence in analysis.disagreements():
        console.print(f"[bold yellow]They disagree:[/] {sentence}.")
    for topic, count in analysis.run.unexplained.items():
        console.print(
            f"[bold red]Invalid:[/] {count} messages of {escape(topic)} are missing, and no channel lost them."
        )
    for note in analysis.run.notes:
        console.print(f"[dim]Note: {escape(note)}.[/]")


def print_side_by_side(analyses: Mapping[str, Observations]) -> None:
    """Print the figures of several runs, a column for each under its name, then what each must be told of."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console(highlight=False)
    table = Table("", *analyses, box=None, pad_edge=False, header_style="bold")
    found = [dict(rows(analysis)) for analysis in analyses.values()]
    for name in dict.fromkeys(name for figures in found for name in figures):
        table.add_row(f"[bold]{name}[/]", *(figures.get(name, "-") for figures in found))
    console.print(table)
    for title, analysis in analyses.items():
        for topic, count in analysis.run.unexplained.items():
            console.print(f"[bold red]{title} is invalid:[/] {count} messages of {escape(topic)} are missing.")
        for sentence in (*analysis.disagreements(), *analysis.run.notes):
            console.print(f"[dim]{title}: {escape(sentence)}.[/]")


def rows(analysis: Observations) -> Iterator[tuple[str, str]]:
    """Name and value of each figure, as text with rich's markup."""
    run, up = analysis.run, analysis.outages.uplink
    ms = 1e3 * run.ts
    seed = f", seed {run.scenario.relay.seed}" if run.seed_known else ""
    yield "Run", f"{len(run)} steps of {ms:g} ms{seed}"
    yield "Uplink", f"{up.loss_rate:.2%} lost, in {up.count} outages of {up.mean_burst:.1f} slots on average"
    if len(causes := loss_causes(run.uplink)) > 1:
        yield "Lost by", ", ".join(f"{cause} ({count})" for cause, count in causes.items())
    yield "Longest outage", f"{up.longest} slots ({up.longest * ms:g} ms)"
    yield (
        "Age of information",
        (f"n_ul: mean {up.age.mean:.2f}, p99 {up.age.p99}, at most {up.age.max} steps ({up.age.max * ms:g} ms)"),
    )
    down = analysis.outages.downlink
    if down.lost or down.age.max:
        yield (
            "Downlink",
            f"{down.loss_rate:.2%} lost, command at most {down.age.max} steps ({down.age.max * ms:g} ms) old",
        )
    found = analysis.convergence
    yield "Settling", f"{_steps(found.settle_1cm_steps, ms)} to 1 cm, {_steps(found.settle_2pct_steps, ms)} to 2 %"
    yield "Overshoot", "no initial error" if found.overshoot is None else f"{found.overshoot:.2%}"
    yield "Damping of the speed", found.damping or "the run cannot tell"
    yield "Error", f"at most {found.position.peak:.3g} m, {found.position.final:.3g} m at the end"
    yield "Fitted channel", _fit(analysis)
    if isinstance(analysis, Analysis):
        yield from _criteria(analysis)
    else:
        yield "Stability", f"not judged: {GAINS_UNKNOWN}"


def _criteria(analysis: Analysis) -> Iterator[tuple[str, str]]:
    yield (
        "Paper's test",
        _verdict(analysis.paper.stable, f"|lambda| at most {analysis.paper.radius:.6g}, at step {analysis.paper.k}"),
    )
    yield (
        f"Pose always {analysis.n} steps old",
        _verdict(analysis.lifted_stable, f"lifted system, spectral radius {analysis.lifted_radius:.6g}"),
    )
    yield f"Any outages up to {analysis.n} slots", _bursts(analysis)
    growth = math.exp(analysis.mean_square_growth)
    both = " of both links" if analysis.verdict.criterion == "both_links" else ""
    yield "Mean square", _verdict(growth < 1.0, f"E\\[e^2] times {growth:.6g} a step under the fitted channel{both}")
    if analysis.floquet is not None:
        motion = "" if analysis.contraction is None else f", {analysis.contraction:.6g} about the motion"
        told = f"times {analysis.floquet:.6g} a step about the reference{motion}"
        yield "These very losses", _verdict(analysis.floquet < 1.0, told)
    colour = {
        "asymptotic": "green",
        "mean-square": "green",
        "bounded": "yellow",
        "unstable": "red",
        "unknown": "yellow",
    }
    verdict = analysis.verdict
    yield "Verdict", f"[bold {colour[verdict.word]}]{verdict.word}[/] (by {verdict.criterion})"
    yield "Margin", verdict.margin


def _fit(analysis: Observations) -> str:
    fit = analysis.fit
    if fit.model == "perfect":
        return "perfect"
    if fit.model == "bernoulli" or fit.p is None or fit.r is None:
        return f"bernoulli, p {_interval(fit.loss_rate)}"
    return f"gilbert_elliott, p {_interval(fit.p)}, r {_interval(fit.r)}"


def _interval(estimate: Estimate) -> str:
    return f"{estimate.value:.4f} ({estimate.low:.4f} .. {estimate.high:.4f})"


def _verdict(stable: bool, why: str) -> str:
    return f"[green]stable[/] ({why})" if stable else f"[red]unstable[/] ({why})"


def _bursts(analysis: Analysis) -> str:
    found = analysis.bursts
    if analysis.bursts_stable:
        return _verdict(True, f"joint spectral radius at most {found.upper:.6g}, proved by a common norm")
    if found.verdict == "unstable":
        return _verdict(False, f"outages of {found.worst} slots grow by {found.lower:.6g} a step")
    return f"[yellow]undecided[/] (joint spectral radius at least {found.lower:.6g})"


def _steps(steps: int | None, ms: float) -> str:
    return "never" if steps is None else f"{steps} steps ({steps * ms / 1e3:g} s)"
