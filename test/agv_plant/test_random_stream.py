"""The random stream against the published cipher, numpy's generator and the uniform distribution."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chisquare, kstest

from agv_plant.random_stream import DRAWS, uniforms

WORD = 2**64


def philox_4x64(counter: tuple[int, int, int, int], key: tuple[int, int]) -> tuple[int, int, int, int]:
    """Philox 4x64-10 as in Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011."""
    (a, b, c, d), (k0, k1) = counter, key
    for _ in range(10):
        high0, low0 = divmod(0xD2E7470EE14C6C93 * a, WORD)
        high1, low1 = divmod(0xCA5A826395121157 * c, WORD)
        a, b, c, d = high1 ^ b ^ k0, low1, high0 ^ d ^ k1, low0
        k0, k1 = (k0 + 0x9E3779B97F4A7C15) % WORD, (k1 + 0xBB67AE8584CAA73B) % WORD
    return a, b, c, d


ONES = WORD - 1


@pytest.mark.parametrize(
    ("counter", "key", "expected"),
    [
        ((0, 0, 0, 0), (0, 0), "16554d9eca36314c db20fe9d672d0fdc d7e772cee186176b 7e68b68aec7ba23b"),
        ((ONES,) * 4, (ONES,) * 2, "87b092c3013fe90b 438c3c67be8d0224 9cc7d7c69cd777b6 a09caebf594f0ba0"),
    ],
)
def test_the_cipher_here_is_the_published_one(
    counter: tuple[int, int, int, int], key: tuple[int, int], expected: str
) -> None:
    # Known answers of Random123, file kat_vectors.
    assert " ".join(f"{word:016x}" for word in philox_4x64(counter, key)) == expected


@settings(deadline=None, derandomize=True, max_examples=30)
@given(st.integers(0, 2**62), st.text(max_size=10), st.integers(0, 2**62), st.integers(1, 5))
def test_each_slot_has_its_counter_of_the_cipher(seed: int, stream: str, first: int, count: int) -> None:
    digest = hashlib.sha256(f"{seed}/{stream}".encode()).digest()
    key = (int.from_bytes(digest[:8], "little"), int.from_bytes(digest[8:16], "little"))
    # numpy counts up before it draws.
    words = [philox_4x64((k + 1, 0, 0, 0), key) for k in range(first, first + count)]
    expected = [[(word >> 11) / 2**53 for word in four] for four in words]
    assert uniforms(seed, stream, first, count).tolist() == expected


def test_they_are_the_doubles_of_numpy_s_own_generator() -> None:
    key = int.from_bytes(hashlib.sha256(b"7/uplink").digest()[:16], "little")
    expected = np.random.Generator(np.random.Philox(key=key, counter=0)).random((1000, 4))
    assert (uniforms(7, "uplink", 0, 1000) == expected).all()


@settings(deadline=None, derandomize=True)
@given(st.integers(0, 5000), st.integers(0, 300), st.integers(0, 2**62))
def test_a_slot_does_not_depend_on_the_others(first: int, count: int, seed: int) -> None:
    part = uniforms(seed, "a", first, count)
    assert part.shape == (count, DRAWS)
    assert (part == uniforms(seed, "a", 0, first + count)[first:]).all()


def test_they_are_uniform_in_every_column() -> None:
    drawn = uniforms(1, "uplink", 0, 50_000)
    assert drawn.min() >= 0.0
    assert drawn.max() < 1.0
    for column in drawn.T:
        assert kstest(column, "uniform").pvalue > 1e-4
        assert chisquare(np.histogram(column, 100, (0.0, 1.0))[0]).pvalue > 1e-4


def test_draws_slots_streams_and_seeds_have_nothing_to_do_with_each_other() -> None:
    count = 20_000
    of_streams = [
        uniforms(seed, stream, 0, count) for seed in (0, 1, 2) for stream in ("uplink", "downlink", "uplink/2")
    ]
    columns = np.concatenate(of_streams, axis=1).T
    correlation = np.corrcoef(columns) - np.eye(len(columns))
    # 630 pairs: five standard deviations of 1 / sqrt(count).
    assert abs(correlation).max() < 5.0 / np.sqrt(count)
    later = [np.corrcoef(columns[0][:-lag], columns[0][lag:])[0, 1] for lag in (1, 2, 3, 4, 100)]
    assert max(map(abs, later)) < 5.0 / np.sqrt(count)


def test_names_and_seeds_are_told_apart() -> None:
    pairs = [(1, "uplink"), (1, "downlink"), (11, "uplink"), (1, "1/uplink"), (1, ""), (0, "uplink")]
    assert len({uniforms(seed, stream, 0, 1).tobytes() for seed, stream in pairs}) == len(pairs)
