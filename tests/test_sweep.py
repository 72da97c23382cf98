"""Stage sweep: in numbers, against the twin, on degenerate input, and depths of a known plane."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from tolerances import DOUBLE

from clsplat import ops, reference
from clsplat.device import Device
from clsplat.renderer import download
from clsplat.testing import assert_matches

# Less than a window, one vector of pixels and its neighbours, and a row of several vectors with a rest.
SIZES = pytest.mark.parametrize(("height", "width"), [(4, 4), (5, 8), (7, 9), (19, 37)])


def sides(device: Device) -> list[tuple[Any, Any]]:
    return [(ops.Launches(device), partial(device.upload, "array")), (reference, np.asarray)]


def compare(stages: Any, up: Any, photo: Any, sources: Any, maps: Any, planes: Any) -> tuple[Any, Any, Any]:
    scores = stages.sweep_scores(up(photo), [up(source) for source in sources], up(maps), up(planes))
    return download(scores), *map(download, stages.sweep_best(scores, up(planes)))


def shifts(*baselines: float) -> Any:
    """Cameras side by side: a plane of inverse depth q is shifted by baseline * q pixels."""
    return np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, baseline, 0, 0] for baseline in baselines], np.float64)


def photo_of(height: int, width: int, seed: int = 0) -> Any:
    """Random grey values, exact in single precision."""
    return np.random.default_rng(seed).integers(0, 256, (height, width)) / 256


@SIZES
def test_matches_twin(configured_device: Device, height: int, width: int) -> None:
    rng = np.random.default_rng(height)
    sources = [photo_of(height + 3, width + 5, 1), photo_of(height, width, 2), photo_of(2, 2, 3)]
    maps = rng.normal([*np.eye(3).ravel(), 0, 0, 0], [*np.full(9, 0.01), 4, 4, 0.01], (3, 12))
    maps = maps.astype(np.float32).astype(np.float64)
    planes = np.linspace(0.25, 1, 7)
    (found, inverse, scores), (expected, *_) = (
        compare(*side, photo_of(height, width), sources, maps, planes) for side in sides(configured_device)
    )
    assert found.shape == (7, height, width)
    if configured_device.real == np.float64:
        assert_matches("scores", found, expected, DOUBLE)
    # Single precision: cancellation in variances of at least 1e-4, where the sums are up to 1.
    np.testing.assert_allclose(found, expected, atol=2e-3)
    chosen = reference.sweep_best(found.astype(np.float64), planes)
    np.testing.assert_allclose(inverse, chosen[0], rtol=1e-3)  # the parabola divides by a small second difference
    np.testing.assert_allclose(scores, chosen[1], atol=1e-6)
    if min(height, width) > 6:
        assert (expected > -1).any() and (expected == -1).any()


def test_a_part_without_texture_is_left_out(any_device: Device) -> None:
    """Vectors and rows that no window with texture needs are not resampled.

    Windows have texture from column 32 to 39: these are the pixels of one vector, but need neighbours in two others.
    """
    photo = photo_of(40, 60)
    photo[:, :34] = photo[:, 38:] = photo[24:] = 0.5
    sources = [photo_of(40, 60, 1), photo_of(40, 60, 2)]
    planes = np.linspace(0.25, 1, 6)
    (found, *_), (expected, *_) = (
        compare(*side, photo, sources, shifts(3, -4), planes) for side in sides(any_device)
    )
    np.testing.assert_allclose(found, expected, atol=2e-3)  # as above
    assert (found[:, 26:] == -1).all() and (found[:, 2:24, 32:40] > -1).all()
    assert (found[:, :, :32] == -1).all() and (found[:, :, 40:] == -1).all()


def test_finds_a_known_plane(any_device: Device) -> None:
    """A textured plane that two cameras at the sides see shifted, and one that sees something else."""
    wide = photo_of(20, 80)
    photo, left, right = wide[:, 20:60], wide[:, 14:54], wide[:, 28:68]
    planes = np.linspace(1, 3, 9)
    for stages, up in sides(any_device):
        _, inverse, scores = compare(stages, up, photo, [left, right, photo_of(20, 40, 5)], shifts(3, -4, 1), planes)
        inner = np.s_[2:-2, 10:-8]
        np.testing.assert_allclose(inverse[inner], 2, rtol=0.02)
        np.testing.assert_allclose(scores[inner], 1, atol=1e-3)
        assert (scores[:2] == -1).all() and (scores[:, -2:] == -1).all(), "windows that leave the photo"


def test_in_numbers(any_device: Device) -> None:
    """The parabola through 0.5, 0.9 and 0.7 has its top a sixth of a gap above the middle."""
    scores = np.array([[0.5, 0.9, 0.7, 0.1], [0.9, 0.1, 0.1, 0.1], [0.2, 0.2, 0.3, 0.8]]).T.reshape(4, 1, 3)
    for stages, up in sides(any_device):
        inverse, largest = map(download, stages.sweep_best(up(scores), up(np.arange(1.0, 5))))
        np.testing.assert_allclose(inverse[0], [2 + 1 / 6, 1, 4], rtol=1e-6)
        np.testing.assert_allclose(largest[0], [0.9, -1, -1], rtol=1e-6)


def test_flat_hidden_and_behind(any_device: Device) -> None:
    """Neither a photo without texture, nor a source out of the frame or behind the camera, tells a depth."""
    photo, planes = photo_of(9, 16), np.linspace(1, 2, 3)
    behind = shifts(0, 0) * -1
    for stages, up in sides(any_device):
        for image, maps in ((np.full((9, 16), 0.5), shifts(1, 2)), (photo, shifts(1e6, -1e6)), (photo, behind)):
            scores, _, largest = compare(stages, up, image, [photo, photo], maps, planes)
            assert (scores == -1).all() and (largest == -1).all()


def test_not_a_number(any_device: Device) -> None:
    photo, planes = photo_of(9, 16), np.linspace(1, 2, 3)
    for stages, up in sides(any_device):
        _, inverse, scores = compare(stages, up, photo, [photo, photo], shifts(np.nan, np.inf), planes)
        assert (scores == -1).all() and np.isfinite(inverse).all()
