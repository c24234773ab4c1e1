"""Long products of small matrices, whose entries would leave the range of a double."""

from __future__ import annotations

import math

import numpy as np

from agv_analysis.run import Floats
from agv_analysis.simulation.compiled import compiled


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


def growths(factors: Floats, passes: int = 8) -> Floats:
    """Logarithms of the moduli of the eigenvalues of a product, largest first, shape (m,); `factors` as above.

    Also of those that the product itself would lose to rounding, by orthogonalisation after each factor, `passes` times
    around (Benettin et al., Meccanica 15, 1980). The largest, and the second if these two are a complex pair, are
    exact; the others are those of directions that have had `passes` rounds to align. -inf for what is annihilated.
    """
    basis = np.eye(factors.shape[-1])
    orthogonalised_pass(factors, basis)  # aligns the directions
    logs = sum((orthogonalised_pass(factors, basis) for _ in range(passes)), np.zeros(len(basis)))
    found = np.sort(logs / passes)[::-1]
    product, log_scale = ordered_product(factors)
    values = np.linalg.eigvals(product)
    largest = values[np.abs(values).argmax()]
    if largest == 0.0:
        return found
    volume, found[0] = found.sum(), log_scale + math.log(abs(largest))
    if abs(largest.imag) > 1e-9 * abs(largest):
        found[1] = found[0]
        if len(found) == 3:
            found[2] = volume - 2.0 * found[0]
    return found


def orthogonalised_pass(factors: Floats, basis: Floats) -> Floats:
    """Send the columns of `basis`, shape (m, m), through all factors, in place; the logarithms of their growth, (m,).

    They are kept orthonormal (Gram-Schmidt after each factor), so the i-th is the growth of the i-th direction.
    """
    logs = np.zeros(len(basis))
    compiled(_orthogonalised_pass)(np.ascontiguousarray(factors), basis, logs)
    return logs


def _orthogonalised_pass(factors: Floats, basis: Floats, logs: Floats) -> None:
    size = basis.shape[0]
    image = np.empty((size, size))
    for k in range(factors.shape[0]):
        for i in range(size):
            for j in range(size):
                image[i, j] = 0.0
                for m in range(size):
                    image[i, j] += factors[k, i, m] * basis[m, j]
        for j in range(size):
            for before in range(j):
                dot = 0.0
                for i in range(size):
                    dot += image[i, j] * basis[i, before]
                for i in range(size):
                    image[i, j] -= dot * basis[i, before]
            square = 0.0
            for i in range(size):
                square += image[i, j] * image[i, j]
            length = math.sqrt(square)
            logs[j] += math.log(length) if length > 0.0 else -math.inf
            for i in range(size):
                basis[i, j] = image[i, j] / length if length > 0.0 else 0.0
