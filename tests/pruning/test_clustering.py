"""K-means with a metric per row: costs against their definition, the metric counts, two levels."""

import numpy as np
import pytest

from clsplat.pruning import clustering
from clsplat.pruning.clustering import features, palette_by_metric


def problem(n=600, seed=0):
    rng = np.random.default_rng(seed)
    rows, factors = rng.normal(size=(n, 4, 3)).astype(np.float32), rng.normal(size=(n, 4, 2))
    return rows, factors @ factors.transpose(0, 2, 1) + 1e-3 * np.eye(4)


def costs(rows, metrics, entries):
    d = rows[:, None] - entries
    return np.einsum("npac,nab,npbc->np", d, metrics, d)


def total(rows, metrics, entries, labels):
    return costs(rows, metrics, entries)[np.arange(len(rows)), labels].sum()


def test_costs_are_inner_products():
    rows, metrics = problem(20)
    entries = problem(5, 1)[0]
    vectors = features(rows, metrics)
    expected = costs(rows, metrics, entries)
    for label in range(5):
        found = clustering._costs(rows, vectors, entries, np.full(20, label))
        np.testing.assert_allclose(found, expected[:, label], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(clustering._closest(vectors, entries), expected.argmin(axis=1))


@pytest.mark.parametrize("leaf", [512, 8])
def test_each_row_has_its_best_entry(monkeypatch, leaf):
    monkeypatch.setattr(clustering, "LEAF", leaf)
    rows, metrics = problem()
    entries, labels = palette_by_metric(rows, features(rows, metrics), 60)
    assert 40 <= len(entries) <= 60 and labels.max() < len(entries)
    assert len(np.unique(labels)) == len(entries), "no entry without a row"
    found = total(rows, metrics, entries, labels)
    assert found <= (1 if leaf == 512 else 1.6) * costs(rows, metrics, entries).min(axis=1).sum() * (1 + 1e-5)
    mean = metrics.mean(axis=0)[None].repeat(len(rows), axis=0)
    other, theirs = palette_by_metric(rows, features(rows, mean), 60)
    assert found < 0.7 * total(rows, metrics, other, theirs), "one metric for all is worse"


def test_few_different_rows_are_found():
    rows = np.repeat(problem(3)[0], 100, axis=0)
    entries, labels = palette_by_metric(rows, features(rows, problem(300)[1]), 50)
    np.testing.assert_allclose(entries[labels], rows, atol=1e-3)


def test_rows_without_weight_do_not_count():
    rows, metrics = problem(200)
    rows[100:], metrics[100:] = 50.0, 0
    entries, labels = palette_by_metric(rows, features(rows, metrics), 20)
    assert np.isfinite(entries).all() and np.abs(entries[np.unique(labels[:100])]).max() < 10
