"""Harmonics under the curvature of the views: against rendering, lower degrees, shared bands."""

from dataclasses import replace

import numpy as np
import pytest
from test_prices import BACKGROUND, cameras, scene

from clsplat.formats.codebook import shared_rows
from clsplat.pruning import harmonics
from clsplat.pruning.harmonics import _matrices, curvatures, fitted_degree, with_shared_bands
from clsplat.pruning.prices import with_degree
from clsplat.render import render
from clsplat.renderer import Renderer


def images(gaussians):
    return [render(gaussians, c, device="reference", background=BACKGROUND).rgb for c in cameras()]


def change(gaussians, other, masks=(None, None)):
    """Sum over the views of the mean squared difference."""
    pairs = zip(images(gaussians), images(other), masks, strict=True)
    squares = [(((a - b) ** 2).sum(axis=2), mask) for a, b, mask in pairs]
    return sum(s.mean() if mask is None else s[mask].mean() for s, mask in squares)


@pytest.mark.parametrize("where", ["reference", "device"])
def test_curvature_is_what_rendering_shows(device64, monkeypatch, where):
    monkeypatch.setattr(harmonics, "SPREAD", 0.0)
    gaussians, views = scene()
    gaussians.sh[:, 0] += 1.0  # no colour below 0
    renderer = Renderer(device64 if where == "device" else "reference", background=BACKGROUND)
    curvature = curvatures(gaussians, views, renderer)
    assert curvature.shape == (30, 136) and curvature.dtype == np.float32
    _, matrices = next(_matrices(curvature, 16))
    rng = np.random.default_rng(0)
    for g in (0, 7, 29):
        d = 0.02 * rng.normal(size=(16, 3))
        sh = gaussians.sh.copy()
        sh[g] += d
        expected = change(gaussians, replace(gaussians, sh=sh), [view.mask for view in views])
        assert np.einsum("ac,ab,bc->", d, matrices[g], d) == pytest.approx(expected, rel=1e-4)


def test_spread_counts_all_directions(device):
    gaussians, views = scene()
    _, plain = next(_matrices(curvatures(gaussians, views[:1], Renderer(device)), 16))
    eigenvalues = np.linalg.eigvalsh(plain[plain[:, 0, 0] > 0])
    ratio = harmonics.SPREAD / (1 - harmonics.SPREAD) / (4 * np.pi)
    # A single view determines one direction; its sum of squares of all 16 basis functions is 16/(4 pi).
    np.testing.assert_allclose(eigenvalues[:, 0] / eigenvalues[:, -1], ratio / (16 / (4 * np.pi) + ratio), rtol=1e-3)


@pytest.mark.parametrize("degree", [0, 1, 2])
def test_a_fitted_degree_changes_the_views_least(device, degree):
    gaussians, views = scene()
    curvature = curvatures(gaussians, views, Renderer(device))
    found = fitted_degree(gaussians, curvature, degree)
    assert found.sh_degree == degree
    assert change(gaussians, found) < 0.7 * change(gaussians, with_degree(gaussians, degree))
    np.testing.assert_array_equal(fitted_degree(gaussians, curvature, 3).sh, gaussians.sh)


def test_what_no_view_shows_is_cut(device):
    gaussians, views = scene()
    gaussians.means[:5] += 1000
    curvature = curvatures(gaussians, views, Renderer(device))
    assert (curvature[:5] == 0).all()
    np.testing.assert_array_equal(fitted_degree(gaussians, curvature, 1).sh[:5], gaussians.sh[:5, :4])
    assert np.isfinite(with_shared_bands(gaussians, curvature, 4).sh).all()


def test_shared_bands(device):
    gaussians, views = scene(200)
    curvature = curvatures(gaussians, views, Renderer(device))
    changes = []
    for size in (1, 20, 100):
        found = with_shared_bands(gaussians, curvature, size)
        rows = found.sh[:, 1:].reshape(200, -1)
        assert len(np.unique(rows, axis=0)) <= size and found.sh.dtype == gaussians.sh.dtype
        assert len(shared_rows(rows, 200)[0]) == len(np.unique(rows, axis=0))
        changes.append(change(gaussians, found))
    assert changes[2] < 0.5 * changes[1] < 0.25 * changes[0]
    again = with_shared_bands(gaussians, curvature, 100)
    np.testing.assert_array_equal(again.sh, found.sh)


def test_band_0_makes_up_for_the_others(device):
    """A single view cannot tell the bands from each other: it stays, whatever the others become."""
    gaussians, views = scene()
    gaussians.sh[:, 0] += 1.0
    curvature = curvatures(gaussians, [replace(views[0], mask=None)], Renderer(device))
    found = with_shared_bands(gaussians, curvature, 1)
    flat = with_degree(gaussians, 0)
    before, after, cut = (images(g)[0] for g in (gaussians, found, flat))
    assert np.abs(after - before).mean() < 0.1 * np.abs(cut - before).mean()
