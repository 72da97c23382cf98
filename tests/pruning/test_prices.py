"""Prices against rendering anew, and the order in which Gaussians go."""

from dataclasses import replace

import numpy as np
import pyopencl.array
import pytest

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.pruning.prices import price, removal_order, sight, with_degree, without_bands
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene

BACKGROUND = (0.2, 0.4, 0.1)
SIZES = [(33, 25), (20, 40)]


def cameras():
    eyes = [(1.5, -1.0, 3.5), (-2.0, 0.5, 3.0)]
    return [Camera.look_at(e, (0, 0, 0), (0, 1, 0), 30.0, *size) for e, size in zip(eyes, SIZES, strict=True)]


def scene(n=30, seed=0):
    """Faint Gaussians, so that no pixel stops and none exceeds white; photos of others, one of them with a mask."""
    gaussians = synthetic_scene(n, seed)[0]
    gaussians.logit_opacities -= 1.5
    gaussians.sh[:, 0] -= 0.5
    rng = np.random.default_rng(seed)
    views = [View(str(i), c, rng.integers(0, 200, (c.height, c.width, 3), np.uint8)) for i, c in enumerate(cameras())]
    views[1] = replace(views[1], mask=rng.random(views[1].image.shape[:2]) < 0.6)
    return gaussians, views


def error(gaussians, views, device="reference", config=RenderConfig()):
    total = 0.0
    for view in views:
        rgb = render(gaussians, view.camera, config, device, background=BACKGROUND).rgb
        assert rgb.max() < 1
        squares = ((rgb - view.image / 255) ** 2).sum(axis=2)
        total += squares[view.mask].mean() if view.mask is not None else squares.mean()
    return total


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_prices_are_what_rendering_anew_shows(device64, mode):
    gaussians, views = scene()
    config, before = RenderConfig(mode=mode), error(*scene(), config=RenderConfig(mode=mode))
    for device in ("reference", device64):
        prices = price(gaussians, views, Renderer(device, config, BACKGROUND))
        for g in (0, 3, 11, 29):
            others = gaussians.take(np.arange(30) != g)
            assert prices.errors[g] == pytest.approx(error(others, views, config=config) - before, rel=1e-8)
            for degree in range(3):
                sh = gaussians.sh.copy()
                sh[g, (degree + 1) ** 2 :] = 0
                change = error(replace(gaussians, sh=sh), views, config=config) - before
                assert prices.bands[g, degree] == pytest.approx(change, rel=1e-8, abs=1e-14)
        assert prices.weights.min() >= 0


def test_what_exceeds_white_is_no_error(device):
    gaussians, views = scene()
    gaussians.sh[:, 0] = 30.0
    white = [replace(v, image=np.full_like(v.image, 255)) for v in views]
    covered = [replace(v, mask=render(gaussians, v.camera, device="reference").rgb.min(axis=2) > 1) for v in white]
    assert all(v.mask.sum() > 100 for v in covered)
    prices = price(gaussians, covered, Renderer(device))
    # With r = 0 only |D|^2 is left; the excess over white would make removal a gain.
    assert (prices.errors >= 0).all()


@pytest.mark.parametrize("brightness", [1, 0.5])
def test_useless_gaussians_go_first(device, brightness):
    """Invisible and faint ones go before those that make up the picture, also where each of these makes it too
    bright: then each alone promises a gain, and without all of them nothing is left."""
    truth = synthetic_scene(25, 3)[0].astype(np.float32)
    truth.log_scales[:] = np.log(0.2)
    truth.logit_opacities[:] = 2.0
    views = [
        View(str(i), c, to_uint8(render(truth, c, device="reference").rgb * brightness))
        for i, c in enumerate(cameras())
    ]
    useless = synthetic_scene(60, 4)[0].astype(np.float32)
    useless.means[:20] += 1000  # beside the picture
    useless.logit_opacities[20:] = -5.0  # alpha at most 1.7/255
    useless.sh[:, 1:] = 0
    mixed = Gaussians.concatenate([useless.take(np.arange(30)), truth, useless.take(np.arange(30, 60))])
    rounds = []
    order = removal_order(mixed, views, lambda left: rounds.append(left) or len(left) < 25, Renderer(device))
    assert sorted(order) == list(range(85))
    # Of the picture's own, a few are hidden behind others.
    assert np.isin(order[:20], np.arange(30, 55)).all()
    assert len(rounds[0]) == int(0.85 * 85) and len(rounds[-1]) < 25 and len(rounds) > 5
    for left in rounds[:-1]:
        np.testing.assert_array_equal(mixed.take(np.sort(order[: len(left)])).means, left.means)
    np.testing.assert_array_equal(order, removal_order(mixed, views, lambda left: len(left) < 25, Renderer(device)))


def test_rounds_see_what_earlier_rounds_spoilt(device):
    """Of two Gaussians at one place each alone is cheap, since the other stands in: only one of them may go."""
    one = synthetic_scene(1, 0)[0].astype(np.float32)
    one.means[:], one.log_scales[:], one.logit_opacities[:], one.sh[:] = 0, np.log(0.3), 7.0, 0
    one.sh[:, 0] = 1.5
    small = one.take(np.zeros(4, int))
    small.means[:, 0], small.log_scales[:], small.logit_opacities[:] = (-1.2, -0.8, 0.8, 1.2), np.log(0.18), 3.0
    both = Gaussians.concatenate([one, one, small])
    views = [View(str(i), c, to_uint8(render(both, c, device="reference").rgb)) for i, c in enumerate(cameras())]
    prices = price(both, views, Renderer(device))
    assert prices.errors[:2].max() < prices.errors[2:].min(), "each of the two alone seems to be worth little"
    order = removal_order(both, views, lambda left: False, Renderer(device))
    assert min(order.tolist().index(0), order.tolist().index(1)) == 0, "together they are worth most"


def test_what_would_add_to_an_error_goes_last(device):
    """Two equal Gaussians; in the photo the place of the first is brighter still."""
    pair = synthetic_scene(1, 0)[0].astype(np.float32).take(np.zeros(2, int))
    pair.means[:], pair.log_scales[:], pair.logit_opacities[:], pair.sh[:] = 0, np.log(0.2), 1.0, 0
    pair.means[:, 0] = -0.8, 0.8
    camera = Camera.look_at((0, 0, 3.5), (0, 0, 0), (0, 1, 0), 40.0, 40, 30)
    for first in (0, 1):
        photo = pair.take(np.arange(2))
        photo.sh[first, 0] = 1.0
        view = View("photo", camera, to_uint8(render(photo, camera, device="reference").rgb))
        prices = price(pair, [view], Renderer(device))
        assert prices.differences[0] == pytest.approx(prices.differences[1], rel=1e-3)
        assert prices.errors[first] > 1.5 * prices.errors[1 - first]
        assert removal_order(pair, [view], lambda left: True, Renderer(device))[0] == first


@pytest.mark.parametrize("masked", [False, True])
def test_the_order_brings_no_photo_to_the_host(device, monkeypatch, masked):
    """Sums of two numbers of twice the precision, 16 bytes per Gaussian and round, whatever the number of photos. At
    commit 0296780 it was 28 for each photo. Photos count equally, however many pixels they have."""
    gaussians, views = scene()
    gaussians = gaussians.astype(np.float32)
    views = [replace(v, mask=v.mask if masked else None) for v in views]
    renderer = Renderer(device, background=BACKGROUND)
    expected = np.argsort(-price(gaussians, views, renderer).costs, kind="stable")
    brought, get = [0], pyopencl.array.Array.get

    def counted(array, *arguments, **options):
        brought[0] += array.nbytes
        return get(array, *arguments, **options)

    monkeypatch.setattr(pyopencl.array.Array, "get", counted)
    for count in (1, 2):
        brought[0] = 0
        order = removal_order(gaussians, views[:count], lambda left: True, renderer)
        assert brought[0] == 16 * len(gaussians)
    np.testing.assert_array_equal(order, expected)


def test_degrees():
    gaussians, _ = scene()
    assert with_degree(gaussians, 1).sh_degree == 1
    assert with_degree(gaussians, 5).sh_degree == 3
    np.testing.assert_array_equal(with_degree(gaussians, 1).sh, gaussians.sh[:, :4])


def test_bands_are_dropped_within_the_budget():
    gaussians, _ = scene(6)
    bands = np.array([[0.1, 0.2, 0], [5, 3, 0.2], [5, 0.3, 0.1], [-1, 0, 0], [9, 9, 9], [9, 9, 0.5]])
    out = without_bands(gaussians, bands, 1.2)
    dropped = [(out.sh[g] != 0).any(axis=1).sum() for g in range(6)]
    # A third of 1.2 for degree 0: rows 0, 3; half of the 1.1 left for degree 1: row 2; 0.8 for degree 2: 1, 5.
    assert dropped == [1, 9, 4, 1, 16, 9]
    np.testing.assert_array_equal(out.sh[4], gaussians.sh[4])
    np.testing.assert_array_equal(without_bands(gaussians, bands + 10, 1.0).sh, gaussians.sh)


def test_nothing_to_price_is_an_error():
    gaussians, views = scene()
    for arguments in ((gaussians, []), (gaussians.take(np.arange(0)), views)):
        with pytest.raises(InputError, match="expected at least one each"):
            price(*arguments, Renderer("reference"))
        with pytest.raises(InputError, match="expected at least one each"):
            removal_order(*arguments, lambda left: True, Renderer("reference"))


def test_orthographic_cameras_see_along_their_axis() -> None:
    camera = Camera(np.eye(4), 50, 50, 20, 15, 40, 30, "orthographic")
    scene = synthetic_scene(5)[0]
    directions, sizes = sight(scene, camera)
    np.testing.assert_array_equal(directions, np.tile([0.0, 0, 1], (5, 1)))
    np.testing.assert_array_equal(sizes, 1 / 50)
