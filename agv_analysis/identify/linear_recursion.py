"""First-order linear recursions z(i) = a(i) z(i-1) + b(i) over whole arrays, without a loop over i."""

from __future__ import annotations

import numpy as np

from agv_analysis.run import Floats

_FORGOTTEN = 1e-14
"""A product of factors a below this changes no digit of a result."""


class Recursion:
    """z(i) = a(i) z(i-1) + b(i), z(-1) = 0, by doubling (Hillis and Steele, Comm. ACM 29, 1986)."""

    def __init__(self, a: Floats) -> None:
        """`a`: factors, |a| <= 1, shape (N,); the first one is not used."""
        self._factors: list[Floats] = []
        product, step = np.array(a, dtype=np.float64), 1
        product[:1] = 0.0
        while step < len(product) and float(np.abs(product).max(initial=0.0)) > _FORGOTTEN:
            self._factors.append(product)
            longer = product.copy()
            longer[step:] *= product[:-step]
            longer[:step] = 0.0
            product, step = longer, 2 * step

    def __call__(self, b: Floats) -> Floats:
        """z for the inputs b, shape (..., N)."""
        z, step = np.array(b, dtype=np.float64), 1
        for factors in self._factors:
            z[..., step:] += factors[step:] * z[..., :-step]
            step *= 2
        return z
