"""What photos may show: never less than the renderer draws, and not much more where that can be known."""

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest

from clsplat.blocks.sight import Bounds, looking_at, may_see, seen
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians
from clsplat.render import renderings
from clsplat.renderer import Renderer

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
    size = rng.integers(8, 200, 2)
    eye, target = rng.normal(size=(2, 3))
    looking = Camera.look_at(eye, target, [0, 0, 1], focal * size[0], *size.tolist())
    cx, cy = size * (0.5 if model == "fisheye" else rng.uniform(-0.1, 1.1, 2))
    return replace(looking, cx=cx, cy=cy, model=model)


@pytest.mark.parametrize(
    ("model", "projection", "focal", "culled"),
    [
        ("pinhole", "affine", 0.2, 0.1),
        ("pinhole", "affine", 1.2, 0.5),
        ("pinhole", "ray", 0.2, 0.1),
        ("pinhole", "ray", 1.2, 0.5),
        ("fisheye", "affine", 0.8, 0.1),
        ("fisheye", "ray", 0.8, 0.1),
        ("orthographic", "affine", 0.1, 0.5),
    ],
)
@pytest.mark.parametrize("seed", range(4))
def test_what_is_drawn_may_be_seen(
    model: str, projection: Literal["affine", "ray"], focal: float, culled: float, seed: int
) -> None:
    gaussians, looking = scattered(seed), camera(seed, model, focal)
    config = RenderConfig(near=1e-3, projection=projection)
    renderer, found = Renderer("reference", config), may_see(looking, Bounds.of(gaussians), config)
    (others,) = renderings(renderer, gaussians.take(~found), [looking])
    assert others.alpha.max() == 0
    (shown,) = renderings(renderer, gaussians.take(found), [looking])
    assert shown.alpha.max() > 0 and (~found).mean() > culled
    # Boxes of 20 neighbours each are seen where one of them is.
    order = np.argsort(gaussians.means[:, 0] + 1000 * np.rint(gaussians.means[:, 1]))
    each = Bounds.of(gaussians.take(order))
    boxes = Bounds(
        each.low.reshape(-1, 20, 3).min(axis=1),
        each.high.reshape(-1, 20, 3).max(axis=1),
        each.radius.reshape(-1, 20).max(axis=1),
    )
    assert not (found[order].reshape(-1, 20).any(axis=1) & ~may_see(looking, boxes, config)).any()


@pytest.mark.parametrize("projection", ["affine", "ray"])
def test_a_panorama_may_show_everything(projection: Literal["affine", "ray"]) -> None:
    panorama = replace(camera(0, "pinhole", 1.2), model="equirectangular")
    assert may_see(panorama, Bounds.of(scattered(0)), RenderConfig(projection=projection)).all()


def test_infinite_sizes_are_seen() -> None:
    gaussians = scattered(0)
    gaussians.log_scales[:] = 800
    assert may_see(camera(0, "pinhole", 1.2), Bounds.of(gaussians), RenderConfig()).all()


def test_any_of_several_cameras_sees() -> None:
    bounds, cameras = Bounds.of(scattered(0)), [camera(k, "pinhole", 1.2) for k in range(3)]
    each = looking_at(cameras, bounds, RenderConfig())
    for one, found in zip(cameras, each, strict=True):
        np.testing.assert_array_equal(found, may_see(one, bounds, RenderConfig()))
    assert looking_at([], bounds, RenderConfig()).shape == (0, len(bounds.radius))
    np.testing.assert_array_equal(seen(cameras, bounds, RenderConfig()), np.logical_or.reduce(each))
    assert (each[0] != each[1]).any()
