"""The closing sentences of a training name the weakest photo, its reason and the remedy."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.commands.generalisation import generalisation
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.testing import synthetic_scene


@pytest.fixture(scope="module")
def scene(device):
    """Photos of a wall of points at depth 5; the held-out camera looks to the right of the training cameras."""
    gaussians = synthetic_scene(50, 4)[0].astype(np.float32)
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-6, 6, (2000, 2)), np.full((2000, 1), 5.0)], axis=1)

    def view(name, x):
        pose = np.eye(4)
        pose[0, 3] = -x
        camera = Camera(pose, 40, 40, 32, 24, 64, 48)
        return View(
            name, camera, (255 * np.clip(render(gaussians, camera, device=device).rgb, 0, 1)).astype(np.uint8)
        )

    train = [view(f"{i}", 0.1 * i) for i in range(4)]
    return gaussians, Scene(train, [view("seen", 0.1), view("beyond", 3.0)], points, np.zeros((2000, 3), np.uint8))


def report(seen, beyond, fitted=20.0):
    views = [{"name": "seen", "psnr": seen}, {"name": "beyond", "psnr": beyond}]
    return {"mean": {"psnr": (seen + beyond) / 2, "psnr_fitted": fitted}, "views": views}


def test_the_reason_is_the_part_that_few_photos_show(scene, device):
    gaussians, photos = scene
    renderer = Renderer(device)
    text = generalisation(gaussians, photos, report(25.0, 15.0), renderer, False)
    assert text.startswith("2 held-out photos have 20.0 dB, training photos ")
    assert "weakest is beyond, 15.0 dB" in text and "mostly on the right, is in the frame of fewer than 3" in text
    assert "exposure" not in text
    text = generalisation(gaussians, photos, report(15.0, 25.0), renderer, False)
    assert "weakest is seen, 15.0 dB: 3 or more training photos have each part of it" in text


def test_the_difference_has_no_sign_if_it_is_zero(scene, device, monkeypatch):
    for trained in (19.99, 20.01):
        monkeypatch.setattr(
            "clsplat.commands.generalisation.training_psnr", lambda *_, found=trained: {"train_psnr": found}
        )
        assert "the difference of 0.0 dB" in generalisation(*scene, report(25.0, 15.0), Renderer(device), False)


def test_exposures_are_named_where_a_fit_of_colours_gains(scene, device):
    text = generalisation(*scene, report(25.0, 15.0, fitted=21.1), Renderer(device), False)
    assert "After a fit of colours it would be 21.1 dB" in text and "--exposure" in text
    again = generalisation(*scene, report(25.0, 15.0, fitted=21.1), Renderer(device), True)
    assert "try --exposure" not in again and "21.1 dB: compare runs" in again
    assert "--exposure" not in generalisation(*scene, report(25.0, 15.0, fitted=20.9), Renderer(device), False)


def test_training_photos_count_as_they_trained(scene, device):
    gaussians, photos = scene
    dark = [replace(view, image=np.rint(view.image / 2).astype(np.uint8)) for view in photos.train]
    even = replace(photos, train=dark, gains={view.name: np.full(3, 0.5) for view in dark})
    texts = [generalisation(gaussians, s, report(25.0, 15.0), Renderer(device), False) for s in (photos, even)]
    levels = [float(text.split("training photos ")[1].split()[0]) for text in texts]
    assert levels[1] > 40 < levels[0], "no error but those of rounding"


@pytest.mark.parametrize(
    ("pixels", "side"), [((0, 15), "at the top"), ((0, -15), "at the bottom"), ((20, 0), "on the left")]
)
def test_the_part_is_named_by_its_side(scene, device, pixels, side):
    """Of a camera whose image reaches beyond the wall's by some pixels."""
    gaussians, photos = scene
    seen = photos.test[0]
    shifted = replace(seen.camera, cx=seen.camera.cx + pixels[0], cy=seen.camera.cy + pixels[1])
    beyond = View("beyond", shifted, seen.image)
    text = generalisation(
        gaussians, replace(photos, test=[seen, beyond]), report(25.0, 15.0), Renderer(device), False
    )
    assert f"mostly {side}, is in the frame of fewer than 3" in text


def test_a_photo_without_errors_is_not_the_weakest(scene, device):
    perfect = report(25.0, 15.0)
    perfect["views"][0]["psnr"] = None
    assert "weakest is beyond, 15.0 dB" in generalisation(*scene, perfect, Renderer(device), False)


def test_without_points_or_errors(scene, device):
    gaussians, photos = scene
    bare = Scene(photos.train, photos.test, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert "more photos from there would help most" in generalisation(
        gaussians, bare, report(25.0, 15.0), Renderer(device), False
    )
    perfect = {"mean": {"psnr": None, "psnr_fitted": None}, "views": []}
    assert "without errors" in generalisation(gaussians, photos, perfect, Renderer(device), False)
