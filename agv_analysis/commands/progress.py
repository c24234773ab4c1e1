"""Progress of long work on the terminal."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def step_bar(steps: float, what: str = "driving") -> Iterator[Callable[[int], None]]:
    """A progress bar over `steps` (inf: unknown) on standard error; yields the function to call with the steps done."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=None if math.isinf(steps) else round(steps))
        yield lambda done: bar.update(task, completed=done)
