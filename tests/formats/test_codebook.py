"""Codebooks and palettes: the stated bound, exactness for few values, and the weights."""

import numpy as np
import pytest

from clsplat.formats import codebook
from clsplat.formats.codebook import CODES, nearest, palette, shared_rows


@pytest.mark.parametrize("kind", ["normal", "uniform", "outlier", "two peaks"])
def test_no_value_is_further_than_promised(kind):
    rng = np.random.default_rng(0)
    values = {
        "normal": rng.normal(size=50_000),
        "uniform": rng.uniform(-3, 5, 50_000),
        "outlier": np.r_[rng.normal(size=50_000), 1000.0],
        "two peaks": np.r_[rng.normal(-9, 0.01, 25_000), rng.normal(9, 0.01, 25_000)],
    }[kind].astype(np.float32)
    book = codebook.codebook(values)
    assert book.shape == (CODES,) and book.dtype == np.float32 and (np.diff(book) >= 0).all()
    codes = nearest(book, values)
    assert codes.dtype == np.uint8
    error = np.abs(book[codes] - values)
    assert (error <= np.abs(book - values[:, None]).min(axis=1) + 1e-6).all() if kind == "normal" else True
    extent = float(np.ptp(values))
    assert error.max() <= extent / 256 * (1 + 1e-3)
    # Evenly spaced entries would have a root mean squared error of extent/256/sqrt(12).
    even = extent / CODES / 12**0.5
    assert np.sqrt((error**2).mean()) < {"uniform": 1.02, "normal": 0.7}.get(kind, 0.02) * even


@pytest.mark.parametrize("count", [1, 2, 255, 256])
def test_few_values_are_kept_exactly(count):
    rng = np.random.default_rng(0)
    values = rng.normal(size=count).astype(np.float32)[rng.integers(count, size=(20_000, 3))]
    book = codebook.codebook(values)
    assert book.shape == (CODES,)
    np.testing.assert_array_equal(book[nearest(book, values)], values)


def test_a_small_palette_is_the_rows_themselves():
    rows = np.random.default_rng(0).normal(size=(1000, 9)).astype(np.float32)
    entries, labels = palette(rows, np.ones(1000, np.float32))
    np.testing.assert_array_equal(entries[labels], rows)


def test_each_row_has_the_nearest_of_its_cell_and_weights_count():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(6000, 9)).astype(np.float32)
    weights = np.where(np.arange(6000) < 1000, 10, 1).astype(np.float32)
    entries, labels = palette(rows, weights)
    assert labels.dtype == np.uint16 and 1200 < len(entries) <= 2000 and labels.max() < len(entries)
    error = np.linalg.norm(entries[labels] - rows, axis=1)
    assert error[:1000].mean() < 0.5 * error[1000:].mean()
    best = np.linalg.norm(entries[:, None] - rows[None, :300], axis=2).min(axis=0)
    assert error[:300].mean() < 1.3 * best.mean() + 1e-3


def test_the_palette_never_exceeds_two_bytes(monkeypatch):
    monkeypatch.setattr(codebook, "PALETTE_MAX", 300)
    monkeypatch.setattr(codebook, "PALETTE_MIN", 300)
    rows = np.random.default_rng(0).normal(size=(5000, 3)).astype(np.float32)
    assert len(palette(rows, np.ones(5000, np.float32))[0]) <= 300


def test_equal_rows_make_no_trouble():
    rows = np.repeat(np.eye(3, dtype=np.float32), 2000, axis=0)
    entries, labels = palette(rows, np.ones(6000, np.float32))
    np.testing.assert_allclose(entries[labels], rows, atol=1e-6)


def test_shared_rows_are_found():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(50, 9)).astype(np.float32)
    rows = few[rng.integers(50, size=6000)]
    entries, labels = shared_rows(rows, 50)
    np.testing.assert_array_equal(entries[labels], rows)
    assert len(entries) == 50 and np.unique(labels, return_index=True)[1].tolist() == sorted(
        np.unique(labels, return_index=True)[1]
    ), "in the order of their first appearance"
    assert shared_rows(rows, 49) is None


def test_shared_rows_make_an_exact_palette():
    rng = np.random.default_rng(0)
    few = rng.normal(size=(1500, 9)).astype(np.float32)
    rows = few[rng.integers(1500, size=6000)]
    entries, labels = palette(rows, np.ones(6000, np.float32))
    assert labels.dtype == np.uint16 and len(entries) <= 1500
    np.testing.assert_array_equal(entries[labels], rows)
