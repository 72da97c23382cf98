"""What photos may show: never less than the renderer draws, and not much more where that can be known."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.blocks.sight import Bounds, may_see, seen
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer, download

COUNT = 4000


def scattered(seed: int) -> Gaussians:
    """Gaussians of all sizes, around cameras near the origin; opaque, so that they reach as far as any."""
    rng = np.random.default_rng(seed)
    means = rng.normal(size=(COUNT, 3)) * rng.choice([1, 10, 300], (COUNT, 1))
    log_scales = rng.uniform(-6, 1, (COUNT, 1)) + rng.normal(size=(COUNT, 3)) * [0.1, 1, 0.1]
    logits = np.full(COUNT, 15.0)
    return Gaussians(means, log_scales, rng.normal(size=(COUNT, 4)), logits, np.zeros((COUNT, 1, 3)))


def camera(seed: int, model: str, focal: float) -> Camera:
    """A camera that looks anywhere, whose principal point is anywhere in its image."""
    rng = np.random.default_rng([1, seed])
    size = rng.integers(8, 400, 2)
    eye, target = rng.normal(size=(2, 3))
    looking = Camera.look_at(eye, target, [0, 0, 1], focal * size[0], *size.tolist())
    cx, cy = size * (0.5 if model == "fisheye" else rng.uniform(-0.1, 1.1, 2))
    return replace(looking, cx=cx, cy=cy, model=model)


@pytest.mark.parametrize(
    ("model", "focal", "culled"), [("pinhole", 0.2, 0.1), ("pinhole", 1.2, 0.5), ("fisheye", 0.8, 0.1)]
)
@pytest.mark.parametrize("seed", range(4))
def test_what_is_drawn_may_be_seen(model: str, focal: float, culled: float, seed: int) -> None:
    gaussians, looking = scattered(seed), camera(seed, model, focal)
    renderer = Renderer("reference", RenderConfig(near=1e-3))
    drawn = download(renderer.forward(gaussians, looking).splats.extents)[:, 0] > 0
    found = may_see(looking, Bounds.of(gaussians))
    assert not (drawn & ~found).any()
    assert drawn.any() and (~found).mean() > culled
    # Boxes of 20 neighbours each are seen where one of them is.
    order = np.argsort(gaussians.means[:, 0] + 1000 * np.rint(gaussians.means[:, 1]))
    each = Bounds.of(gaussians.take(order))
    boxes = Bounds(
        each.low.reshape(-1, 20, 3).min(axis=1),
        each.high.reshape(-1, 20, 3).max(axis=1),
        each.radius.reshape(-1, 20).max(axis=1),
    )
    assert not (found[order].reshape(-1, 20).any(axis=1) & ~may_see(looking, boxes)).any()


@pytest.mark.parametrize(
    ("model", "along_rays"), [("orthographic", False), ("equirectangular", True), ("pinhole", True)]
)
def test_everything_may_be_seen_where_no_bounds_are_known(model: str, along_rays: bool) -> None:
    assert may_see(replace(camera(0, "pinhole", 1.2), model=model), Bounds.of(scattered(0)), along_rays).all()


def test_infinite_sizes_are_seen() -> None:
    gaussians = scattered(0)
    gaussians.log_scales[:] = 800
    assert may_see(camera(0, "pinhole", 1.2), Bounds.of(gaussians)).all()


def test_any_of_several_cameras_sees() -> None:
    bounds, cameras = Bounds.of(scattered(0)), [camera(k, "pinhole", 1.2) for k in range(3)]
    each = [may_see(one, bounds) for one in cameras]
    np.testing.assert_array_equal(seen(cameras, bounds, False), np.logical_or.reduce(each))
    assert (each[0] != each[1]).any()
