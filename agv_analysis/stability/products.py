"""Long products of small matrices, whose entries would leave the range of a double."""

from __future__ import annotations

import math
from itertools import combinations

import numpy as np

from agv_analysis.compiled.functions import compiled
from agv_analysis.run import Floats
from agv_ros.substitution import Replacements


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
    """Logarithm of the spectral radius of `ordered_product`; -inf for a nilpotent one, inf beyond a double's range."""
    with np.errstate(over="ignore", invalid="ignore"):
        product, log_scale = ordered_product(factors)
    if not np.isfinite(product).all():
        return np.inf
    radius = float(np.abs(np.linalg.eigvals(product)).max())
    return log_scale + float(np.log(radius)) if radius > 0.0 else -np.inf


def growths(factors: Floats, count: int | None = None) -> Floats:
    """Logarithms of the moduli of the `count` largest eigenvalues of a product, largest first, all m by default.

    Also of those that the product itself would lose to rounding: the matrix of all minors of order i (i-th compound) of
    a product is the product of those of its factors, and its largest eigenvalue is the product of the i largest (Horn
    and Johnson, Matrix Analysis, 2nd ed., 0.8.1). -inf for what is annihilated. `factors` as of `ordered_product`.
    """
    orders = range(1, (count or factors.shape[-1]) + 1)
    of_largest = [log_spectral_radius(_minors(factors, order) if order > 1 else factors) for order in orders]
    with np.errstate(invalid="ignore"):
        found = np.diff(of_largest, prepend=0.0)
    return np.where(np.isnan(found), -np.inf, found)


def _minors(factors: Floats, order: int) -> Floats:
    """Compound matrices of factors of shape (N, m, m): shape (N, c, c), c = m over `order`."""
    chosen = np.array(list(combinations(range(factors.shape[-1]), order)))
    return np.asarray(np.linalg.det(factors[:, chosen[:, None, :, None], chosen[None, :, None, :]]))


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
        multiply(factors[k], basis, False, image, False)
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


def row_count(A: Floats) -> int:
    """Number of rows of a matrix, asked by the functions below; see `of_size_3`."""
    return len(A)


def column_count(A: Floats) -> int:
    """Number of its columns."""
    return int(A.shape[1])


def three(_: Floats) -> int:
    """3, whatever the matrix."""
    return 3


def of_size_3(*stacks: Floats | None) -> Replacements | None:
    """Replacements for a function that is compiled, where all matrices, shape (..., p, r), are 3 x 3; else None.

    A compiler that knows the sizes writes the loops below out, which makes them several times as fast.
    """
    is_3 = all(stack is None or stack.shape[-2:] == (3, 3) for stack in stacks)
    return {row_count: three, column_count: three, multiply: multiply_3} if is_3 else None


def assign(source: Floats, target: Floats) -> None:
    """`target` = `source`, shape (p, r); of a larger `source` its first rows and columns.

    Written out, as what follows: numba takes seconds to compile `target[:] = source` or `matrix /= divisor`.
    """
    for i in range(row_count(target)):
        for j in range(column_count(target)):
            target[i, j] = source[i, j]


def divide(matrix: Floats, divisor: float) -> None:
    """`matrix` /= `divisor`, shape (p, r)."""
    for i in range(row_count(matrix)):
        for j in range(column_count(matrix)):
            matrix[i, j] /= divisor


def largest_entry(matrix: Floats) -> float:
    """Largest modulus of the entries of a matrix, NaN if one is NaN."""
    largest = 0.0
    for i in range(row_count(matrix)):
        for j in range(column_count(matrix)):
            size = abs(matrix[i, j])
            if size > largest or math.isnan(size):
                largest = size
    return largest


def multiply(A: Floats, B: Floats, transposed: bool, product: Floats, add: bool) -> None:
    """`product` = A B, or A B' if `transposed`; added to what is there if `add`. Shapes (p, s), (s, r) and (p, r).

    Written to be compiled into its callers, where numpy's own costs more than the product.
    """
    for i in range(row_count(product)):
        for j in range(column_count(product)):
            value = product[i, j] if add else 0.0
            for m in range(column_count(A)):
                value += A[i, m] * (B[j, m] if transposed else B[m, j])
            product[i, j] = value


Entries = tuple[float, float, float, float, float, float, float, float, float]
"""Those of a 3 x 3 matrix, row by row."""

ZERO: Entries = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
IDENTITY: Entries = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def entries(B: Floats) -> Entries:
    """Those of B, shape (3, 3)."""
    return B[0, 0], B[0, 1], B[0, 2], B[1, 0], B[1, 1], B[1, 2], B[2, 0], B[2, 1], B[2, 2]


def times(A: Floats, B: Entries, added: Entries = ZERO) -> Entries:
    """A B, and `added`, in the order of `multiply`: the same to the last bit.

    Numbers, not arrays, of which a compiler cannot tell whether they overlap: they stay in registers.
    """
    a, b, c, d, e, f, g, h, i = A[0, 0], A[0, 1], A[0, 2], A[1, 0], A[1, 1], A[1, 2], A[2, 0], A[2, 1], A[2, 2]
    return (
        added[0] + a * B[0] + b * B[3] + c * B[6],
        added[1] + a * B[1] + b * B[4] + c * B[7],
        added[2] + a * B[2] + b * B[5] + c * B[8],
        added[3] + d * B[0] + e * B[3] + f * B[6],
        added[4] + d * B[1] + e * B[4] + f * B[7],
        added[5] + d * B[2] + e * B[5] + f * B[8],
        added[6] + g * B[0] + h * B[3] + i * B[6],
        added[7] + g * B[1] + h * B[4] + i * B[7],
        added[8] + g * B[2] + h * B[5] + i * B[8],
    )


def multiply_3(A: Floats, B: Floats, transposed: bool, product: Floats, add: bool) -> None:
    """As `multiply`, where all are 3 x 3."""
    found = times(A, entries(B.T) if transposed else entries(B), entries(product) if add else ZERO)
    for i in range(3):
        product[i, 0], product[i, 1], product[i, 2] = found[3 * i], found[3 * i + 1], found[3 * i + 2]


def multiply_sparse(A: Floats, X: Floats, product: Floats) -> None:
    """`product` = A X, shapes (n, n), passing over the zeros of A, which are most of it; for compiled callers."""
    size = A.shape[0]
    for i in range(size):
        for j in range(size):
            product[i, j] = 0.0
        for m in range(size):
            factor = A[i, m]
            if factor != 0.0:
                for j in range(size):
                    product[i, j] += factor * X[m, j]
