"""Where a loop changes from stable to unstable, and back, as one number grows: a loss probability, a burst, a delay.

More of it need not be worse: behind a wrong predictor rare receptions may do harm that yet rarer ones do not. So no
search here assumes that a loop which is unstable at some number is so at all larger ones. Margins are first
borders: the largest number up to which all smaller ones are stable, as far as a grid can tell.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

_GOLDEN = 0.5 * (3.0 - math.sqrt(5.0))

_NARROWINGS = 8
"""How often the place of a peak below zero is narrowed down, in search of a value above it."""


def borders(growth: Callable[[float], float], grid: Sequence[float]) -> tuple[float, ...]:
    """Where the growth, negative where the loop is stable, changes its sign on a rising grid; to 1e-9.

    Beginning with the first value of the grid if it is not stable there, which then is all that is returned. A peak
    below zero is looked at closely, since it may rise above it between two values of the grid.
    """
    if growth(grid[0]) >= 0.0:
        return (grid[0],)
    places = sorted({*grid, *_above_zero(growth, grid)})
    found = []
    for low, high in itertools.pairwise(places):
        if (growth(low) >= 0.0) != (growth(high) >= 0.0):
            found.append(crossing(growth, low, high))
    return tuple(found)


def _above_zero(growth: Callable[[float], float], grid: Sequence[float]) -> list[float]:
    """Places between those of the grid at which the growth is not negative although it is at their neighbours."""
    found = []
    for low, middle, high in zip(grid, grid[1:], grid[2:], strict=False):
        values = growth(low), growth(middle), growth(high)
        if not (all(map(math.isfinite, values)) and max(values) == values[1] < 0.0):
            continue
        for _ in range(_NARROWINGS):
            is_upper = high - middle > middle - low
            x = middle + _GOLDEN * (high - middle) if is_upper else middle - _GOLDEN * (middle - low)
            if growth(x) >= 0.0:
                found.append(x)
                break
            if growth(x) > growth(middle):
                low, middle, high = (middle, x, high) if is_upper else (low, x, middle)
            else:
                low, high = (low, x) if is_upper else (x, high)
    return found


def crossing(f: Callable[[float], float], low: float, high: float) -> float:
    """Where a continuous function changes its sign between `low` and `high`, to 1e-9 (Chandrupatla, 1997).

    Inverse quadratic interpolation where three points allow it, bisection elsewhere (Adv. Eng. Software 28, 145).
    """
    b, c, share = low, high, 0.5
    fb, fc = f(b), f(c)
    a, fa = c, fc
    for _ in range(100):
        x = b + share * (c - b)
        fx = f(x)
        if (fx > 0.0) == (fb > 0.0):
            a, fa = b, fb
        else:
            a, fa, c, fc = c, fc, b, fb
        b, fb = x, fx
        if fb == 0.0 or abs(c - b) <= 1e-9 * max(1.0, abs(b)):
            break
        share = 0.5
        if math.isfinite(fa) and math.isfinite(fc) and fa != fc and fa != fb:
            along, across = (b - c) / (a - c), (fb - fc) / (fa - fc)
            if across**2 < along and (1.0 - across) ** 2 < 1.0 - along:
                share = fb / (fc - fb) * fa / (fc - fa) + (a - b) / (c - b) * fb / (fa - fb) * fc / (fa - fc)
                share = min(0.999, max(1e-3, share))
    return b if abs(fb) < abs(fc) else c


def last_stable(is_stable: Callable[[int], bool], guess: float, limit: int) -> int | None:
    """Largest n up to which all are stable, searched for about a guess; -1: not even 0 is, None: all up to `limit`.

    Of the smaller ones a few dozen are asked, all up to 8 among them.
    """
    stable, step = min(limit, math.ceil(guess) - 1), 1
    while stable >= 0 and not is_stable(stable):
        stable, step = max(-1, stable - step), 2 * step
    unstable, step = stable + 1, 1
    while is_stable(unstable):
        if unstable >= limit:
            unstable = limit + 1
            break
        stable, unstable, step = unstable, min(unstable + step, limit), 2 * step
    first = next((n for n in spread(unstable) if not is_stable(n)), unstable)
    stable = max((n for n in spread(unstable) if n < first), default=-1)
    while first - stable > 1:
        middle = (stable + first) // 2
        stable, first = (middle, first) if first > limit or is_stable(middle) else (stable, middle)
    return None if first > limit else stable


def stable_again(is_stable: Callable[[int], bool], last: int, limit: int) -> tuple[int, int] | None:
    """(first, last) of the n beyond `last`, up to ten times as large, that are stable again; None if none was found.

    Those asked lie a tenth apart; `last` is what `last_stable` found, of a loop that is stable at n = 0.
    """
    beyond = [n for n in spread(min(limit, 10 * (last + 1)) + 1) if n > last + 1]
    first = next((n for n in beyond if is_stable(n)), None)
    if first is None:
        return None
    before = max((n for n in beyond if n < first), default=last + 1)
    while first - before > 1:
        middle = (before + first) // 2
        before, first = (before, middle) if is_stable(middle) else (middle, first)
    end = first
    while end < limit and is_stable(end + 1):
        end += 1
    return first, end


def spread(end: int) -> list[int]:
    """Numbers below `end`: all up to 8, then each a tenth larger than the one before."""
    found = list(range(min(end, 9)))
    while found and (following := max(found[-1] + 1, round(1.1 * found[-1]))) < end:
        found.append(following)
    return found


def not_monotone(found: Sequence[float], digits: int) -> str:
    """What must be said of a margin that is the first of several borders; empty if there is but one."""
    if len(found) < 2:
        return ""
    first, second = (f"{x:.{digits}g}" for x in found[:2])
    again = f"beyond {second}" if len(found) == 2 else f"between {second} and {found[2]:.{digits}g}"
    return f"not monotone: unstable between {first} and {second}, stable again {again}"
