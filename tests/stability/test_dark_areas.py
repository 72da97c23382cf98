"""Dark areas turn transparent, because black Gaussians look like a black background (Brush #250)."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from test_loading import write_colmap

from clsplat.bench.stability.small import CONFIG, small_scene, soot
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.render import render
from clsplat.training.coarse_to_fine import shrunk
from clsplat.training.loop import train

RANDOM = DataConfig(random_background=True)


@pytest.mark.parametrize("cut_out", [True, False], ids=["transparent photos", "opaque photos"])
def test_black_objects_stay_opaque(device, tmp_path, cut_out):
    scene, opacity = soot(small_scene(device), device), {}
    solid = [view.clear < 25 for view in scene.test]
    if not cut_out:
        scene = replace(scene, train=[replace(view, clear=None) for view in scene.train])
    for data in (DataConfig(), RANDOM):
        gaussians = train(scene, replace(CONFIG, data=data), tmp_path, device)
        alphas = [render(gaussians, view.camera, device=device).alpha for view in scene.test]
        opacity[data.random_background] = np.mean([a[s].mean() for a, s in zip(alphas, solid, strict=True)])
    # Measured opacity: 0.00 with a black background, 0.99 and 1.00 with random ones.
    assert opacity[False] < 0.1
    assert opacity[True] > 0.95


def test_transparency_is_loaded_if_needed(tmp_path):
    write_colmap(tmp_path)
    rgba = np.random.default_rng(0).integers(0, 256, (12, 16, 4), dtype=np.uint8)
    Image.fromarray(rgba).save(tmp_path / "images" / "00.png")
    plain, scene = (load_scene(tmp_path, data) for data in (DataConfig(), RANDOM))
    assert all(view.clear is None for view in plain.train + plain.test + scene.train)
    view = scene.test[0]
    assert (view.name, view.clear.dtype) == ("00.png", np.uint8)
    np.testing.assert_array_equal(view.image, plain.test[0].image)
    np.testing.assert_allclose(view.clear, 255 - rgba[..., 3].astype(float), atol=1)
    white = load_scene(tmp_path, DataConfig(background="white")).test[0]
    # Both photos and their difference are rounded.
    np.testing.assert_allclose(view.on((1, 1, 1), (0, 0, 0)).astype(float), white.image, atol=1)
    np.testing.assert_array_equal(view.on((0, 0, 0), (0, 0, 0)), view.image)
    half = shrunk(view, 2)
    assert half.clear.shape == half.image.shape[:2] == (6, 8)
    np.testing.assert_allclose(half.clear, view.clear.reshape(6, 2, 8, 2).mean(axis=(1, 3)), atol=1)
