"""A scene that shows nothing of its photos is called a failure."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.config import InitConfig
from clsplat.metrics import to_uint8
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.training.initialize import initialize
from clsplat.training.loop import train
from clsplat.training.outcome import FEWEST_GAUSSIANS, failure


@pytest.fixture
def scene(device):
    return small_scene(device)


def test_a_short_training_is_no_failure_but_black_is(scene, device, tmp_path):
    gaussians = train(scene, replace(CONFIG, iterations=60), tmp_path, device)
    assert failure(gaussians, scene.train, Renderer(device)) is None
    gaussians.sh[:] = -10
    assert "a constant colour" in failure(gaussians, scene.train, Renderer(device))


def test_almost_no_gaussians_are_a_failure(scene, device):
    gaussians = initialize(scene, InitConfig(opacity=0.9), seed=0)
    few = gaussians.take(np.arange(FEWEST_GAUSSIANS - 1))
    assert f"{FEWEST_GAUSSIANS - 1} Gaussians" in failure(few, scene.train, Renderer(device))
    enough = gaussians.take(np.arange(FEWEST_GAUSSIANS))
    assert "are left" not in (failure(enough, scene.train, Renderer(device)) or "")


def test_the_constant_colour_is_the_mean_of_each_photo(scene, device):
    """By hand: a quarter of the pixels is white. Black has the error 1/4, 6.0 dB, and grey 3/16, 7.3 dB."""
    gaussians = initialize(scene, InitConfig(opacity=0.9), seed=0)
    gaussians.sh[:, 0] = -10
    photos = []
    for view in scene.train:
        image = np.zeros_like(view.image)
        image[: len(image) // 4] = 255
        assert len(image) % 4 == 0
        photos.append(replace(view, image=image))
    found = failure(gaussians, photos, Renderer(device))
    assert "its photos have 6.0 dB, where a constant colour for each has 7.3 dB" in found


def test_photos_that_show_nothing_are_a_failure_if_all_do(scene, device):
    black = [replace(view, image=np.zeros_like(view.image)) for view in scene.train]
    gaussians = initialize(scene, InitConfig(opacity=0.9), seed=0)
    assert "single colour" in failure(gaussians, black, Renderer(device))
    many = [*black, scene.train[0], *black]  # those that are compared are all black
    assert failure(gaussians, many, Renderer(device)) is None


def test_only_the_pixels_of_the_mask_count(scene, device):
    gaussians = initialize(scene, InitConfig(opacity=0.9), seed=0)
    masked = [replace(view, mask=np.zeros(view.image.shape[:2], bool)) for view in scene.train]
    gaussians.sh[:] = -10
    assert "no pixel that counts" in failure(gaussians, masked, Renderer(device))


def test_colours_beyond_white_are_white(scene, device):
    gaussians, renderer = initialize(scene, InitConfig(opacity=0.9), seed=0), Renderer(device)
    gaussians.sh[:] = 10
    cameras = [view.camera for view in scene.train]
    images = [to_uint8(rendering.rgb) for rendering in renderings(renderer, gaussians, cameras)]
    photos = [replace(view, image=image) for view, image in zip(scene.train, images, strict=True)]
    assert failure(gaussians, photos, renderer) is None


def test_noise_of_one_level_shows_nothing(scene, device):
    """By hand: values of 100 and 101 differ from their mean by half a level."""
    rng = np.random.default_rng(0)
    grey = [replace(v, image=rng.integers(100, 102, v.image.shape, dtype=np.uint8)) for v in scene.train]
    gaussians = initialize(scene, InitConfig(opacity=0.9), seed=0)
    assert "single colour" in failure(gaussians, grey, Renderer(device))
