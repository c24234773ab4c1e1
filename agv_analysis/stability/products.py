"""Long products of small matrices, whose entries would leave the range of a double."""

from __future__ import annotations

import numpy as np

from agv_analysis.run import Floats


def ordered_product(factors: Floats) -> tuple[Floats, float]:
    """The product factors[N-1] ... factors[1] factors[0] of shape (N, m, m) as (P, log_scale): exp(log_scale) P.

    Neighbours are multiplied pairwise, so the work is that of about log2 N array operations. The largest entry of P is
    1 in modulus; a product that is exactly 0 has P = 0 and log_scale = 0. N >= 1.
    """
    product, log_scale = np.asarray(factors, dtype=np.float64), np.zeros(len(factors))
    while len(product) > 1:
        odd, odd_scale = product[len(product) & ~1 :], log_scale[len(product) & ~1 :]
        paired = product[1::2] @ product[0 : len(product) & ~1 : 2]
        scale = log_scale[1::2] + log_scale[0 : len(product) & ~1 : 2]
        size = np.abs(paired).max(axis=(1, 2))
        size[size == 0.0] = 1.0
        product = np.concatenate((paired / size[:, None, None], odd))
        log_scale = np.concatenate((scale + np.log(size), odd_scale))
    return product[0], float(log_scale[0])


def log_spectral_radius(factors: Floats) -> float:
    """Logarithm of the spectral radius of `ordered_product`; -inf for a nilpotent one."""
    product, log_scale = ordered_product(factors)
    radius = float(np.abs(np.linalg.eigvals(product)).max())
    return log_scale + float(np.log(radius)) if radius > 0.0 else -np.inf
