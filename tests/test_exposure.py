"""Stage exposure: in numbers, against the twin, and against central differences; then its parameters per photo."""

from functools import partial

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.config import OptimConfig
from clsplat.reference.exposure import squared_radius
from clsplat.testing import assert_matches, gradcheck
from clsplat.training import photo_exposures as exposure

# One pixel; less than, and more than what a work-item has, on a CPU and on a GPU.
SIZES = [(1, 1), (5, 7), (64, 64), (65, 64), (97, 131)]


COLUMNS = pytest.mark.parametrize("columns", [4, 6], ids=["affine", "response"])


def inputs(height, width, columns=4):
    """Image, map, photo and gradient, exact in single precision; a third of the photo each is black and white."""
    rng = np.random.default_rng(height)
    arrays = rng.uniform(0, 1, (height, width, 3)), rng.normal(size=(3, columns)), rng.normal(size=(height, width, 3))
    image, affine, v_image = (a.astype(np.float32).astype(np.float64) for a in arrays)
    return [image, affine, rng.choice([0, 128, 255], image.shape).astype(np.uint8), v_image]


def by_kernel(device, image, affine, photo, v_image):
    x, p, v = device.upload("image", image), device.upload("photo", photo, np.uint8), device.upload("v", v_image)
    adjusted = ops.exposure_fwd(device, x, affine, p)
    v_affine = ops.exposure_bwd(device, x, affine, p, v)
    np.testing.assert_array_equal(x.get(), image.astype(device.real))
    return adjusted.get(), v.get(), v_affine


def by_twin(image, affine, photo, v_image):
    v = v_image.copy()
    adjusted = reference.exposure_fwd(image, affine, photo)
    v_affine = reference.exposure_bwd(image, affine, photo, v)
    return adjusted, v, v_affine


def test_in_numbers(any_device):
    """Channels are mixed by rows, then shifted."""
    image = np.array([[[1.0, 2.0, 3.0]]])
    affine = np.array([[1.0, 10.0, 100.0, 0.5], [0, 0, 2, 0], [0, 0, 0, -1]])
    v = np.array([[[1.0, 2.0, 4.0]]])
    photo = np.full((1, 1, 3), 128, np.uint8)
    for run in (by_twin, partial(by_kernel, any_device)):
        adjusted, v_image, v_affine = run(image, affine, photo, v)
        np.testing.assert_array_equal(adjusted, [[[321.5, 6, -1]]])
        np.testing.assert_array_equal(v_image, [[[1, 10, 104]]])
        np.testing.assert_array_equal(v_affine, [[1, 2, 3, 1], [2, 4, 6, 2], [4, 8, 12, 4]])


def test_what_the_camera_clips_counts_as_clipped(any_device):
    """Beyond white where the photo is white and below black where it is black, and nowhere else."""
    image = np.array([[[1.5, -0.5, 0.5], [1.5, -0.5, 2.0], [0.875, 0.125, -3.0]]])
    photo = np.array([[[255, 0, 255], [254, 1, 0], [255, 0, 255]]], np.uint8)
    v = np.arange(1.0, 10).reshape(1, 3, 3)
    for run in (by_twin, partial(by_kernel, any_device)):
        adjusted, v_image, v_affine = run(image, exposure.IDENTITY, photo, v)
        expected = image.copy()
        expected[0, 0] = [1, 0, 0.5]
        np.testing.assert_array_equal(adjusted, expected.astype(any_device.real))
        np.testing.assert_array_equal(v_image, [[[0, 0, 3], [4, 5, 6], [7, 8, 9]]])
        np.testing.assert_array_equal(v_affine[:, 3], [4 + 7, 5 + 8, 3 + 6 + 9])


@COLUMNS
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_matches_twin(any_device, height, width, columns):
    check(any_device, height, width, columns)


@COLUMNS
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_matches_twin_as_cpu_and_gpu(configured_device, height, width, columns):
    check(configured_device, height, width, columns)


def check(device, height, width, columns):
    given = inputs(height, width, columns)
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    for name, found, expected in zip(
        ("image", "v_image", "v_affine"), by_kernel(device, *given), by_twin(*given), strict=True
    ):
        assert_matches(name, found, expected, tolerances)


@COLUMNS
def test_gradients_by_central_differences(device64, columns):
    image, affine, photo, v = inputs(9, 11, columns)
    _, v_image, v_affine = by_kernel(device64, image, affine, photo, v)
    assert (v_image == 0).any() or columns == 6
    gradcheck(
        lambda image, affine: float((by_kernel(device64, image, affine, photo, v)[0] * v).sum()),
        {"image": image, "affine": affine},
        {"image": v_image, "affine": v_affine},
    )


def test_curve_and_vignetting_in_numbers(any_device):
    """The corner of an image is darker by the whole falloff, its middle by nothing; the curve vanishes at 0 and 1."""
    image = np.full((3, 3, 3), 0.5)
    image[0, 1], image[1, 0] = 0, 1
    affine = np.concatenate([np.eye(3, 4), [[0.4, -0.25], [0.4, -0.25], [0.4, -0.5]]], axis=1)
    photo = np.full(image.shape, 128, np.uint8)
    for run in (by_twin, partial(by_kernel, any_device)):
        adjusted, _, v_affine = run(image, affine, photo, np.ones_like(image))
        np.testing.assert_allclose(adjusted[1, 1], 0.5 + 0.4 * 0.25, rtol=1e-6)
        # Of a side of 3 pixels, the centres of the corner pixels are two thirds of the way to the corners.
        np.testing.assert_allclose(adjusted[0, 0], 0.6 - np.array([0.25, 0.25, 0.5]) * (2 / 3) ** 2 * 0.5, rtol=1e-6)
        np.testing.assert_allclose(adjusted[0, 1], 0, atol=1e-6)
        np.testing.assert_allclose(v_affine[:, 4], 7 * 0.25, rtol=1e-6)
        np.testing.assert_allclose(v_affine[:, 5], 4 / 9 * 4 * 0.5 + 2 / 9 * (1 + 2 * 0.5), rtol=1e-6)


def test_photos_find_their_curves_and_the_common_vignetting():
    rng = np.random.default_rng(0)
    image, photo = rng.uniform(0, 1, (8, 8, 3)), np.full((8, 8, 3), 128, np.uint8)
    truth = {}
    for k, curve in enumerate((-0.2, 0.0, 0.2)):
        truth[f"{k}.png"] = np.concatenate([np.eye(3, 4), np.full((3, 1), curve), np.full((3, 1), -0.3)], axis=1)
    exposures, config = exposure.start(list(truth), response=True), OptimConfig()
    for k in range(3000):
        name = list(truth)[k % 3]
        affine = exposures.of(name)
        off = reference.exposure_fwd(image, affine, photo) - reference.exposure_fwd(image, truth[name], photo)
        v = 2 * off / image.size
        exposure.update(exposures, name, reference.exposure_bwd(image, affine, photo, v), k / 3000, config)
        np.testing.assert_allclose(exposures.values.mean(axis=0)[:, :5], exposure.RESPONSE[:, :5], atol=1e-12)
    for name, expected in truth.items():
        np.testing.assert_allclose(exposures.of(name), expected, atol=0.03)


def test_no_lens_brightens_the_corners():
    image, photo = np.full((8, 8, 3), 0.5), np.full((8, 8, 3), 128, np.uint8)
    exposures = exposure.start(["a.png", "b.png"], response=True)
    for k in range(50):
        affine = exposures.of("a.png")
        v = reference.exposure_fwd(image, affine, photo) - image * (1 + 0.3 * squared_radius(8, 8))
        exposure.update(exposures, "a.png", reference.exposure_bwd(image, affine, photo, v), k / 50, OptimConfig())
        assert (exposures.values[:, :, 5] == 0).all()


def test_photos_find_their_exposures_and_the_mean_stays():
    """Descent on |A x + b - y|^2 for photos of three gains: their ratios are found, and the mean map is none."""
    rng = np.random.default_rng(0)
    image, photo = rng.uniform(0, 1, (8, 8, 3)), np.full((8, 8, 3), 128, np.uint8)
    gains = {"a.png": 0.8, "b.png": 1.0, "c.png": 1.2}
    exposures = exposure.start(list(gains))
    config = OptimConfig()
    for k in range(1500):
        name = list(gains)[k % 3]
        affine = exposures.of(name)
        v = 2 * (reference.exposure_fwd(image, affine, photo) - gains[name] * image) / image.size
        exposure.update(exposures, name, reference.exposure_bwd(image, affine, photo, v), k / 1500, config)
        np.testing.assert_allclose(exposures.values.mean(axis=0), exposure.IDENTITY, atol=1e-12)
    for name, gain in gains.items():
        expected = np.hstack([gain * np.eye(3), np.zeros((3, 1))])
        # Half a step of the last rate, and what is left of the way there.
        np.testing.assert_allclose(exposures.of(name), expected, atol=0.01)


def test_gains_are_found_in_few_steps():
    """A short training takes a photo some 25 times. At one learning rate for all numbers of a map, the error would be
    0.015: Adam mixes channels and shifts black in place of most of the gain."""
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1, (8, 8, 1)) + rng.normal(0, 0.05, (8, 8, 3))  # channels of photos are alike
    photo, gains = np.full((8, 8, 3), 128, np.uint8), {"a.png": 0.8, "b.png": 1.0, "c.png": 1.2}
    exposures = exposure.start(list(gains))
    for k in range(75):
        name = list(gains)[k % 3]
        affine = exposures.of(name)
        v = np.sign(reference.exposure_fwd(image, affine, photo) - gains[name] * image) / image.size
        exposure.update(exposures, name, reference.exposure_bwd(image, affine, photo, v), k / 75, OptimConfig())
    for name, gain in gains.items():
        found = reference.exposure_fwd(image, exposures.of(name), photo)
        assert np.abs(found - gain * image).mean() < 0.004  # one level of 8 bits


def test_a_photo_is_seen_as_the_scene_would_show_it():
    photo = np.random.default_rng(0).integers(20, 200, (4, 5, 3), dtype=np.uint8)
    affine = np.array([[1.1, 0.02, 0, 0.01], [0, 0.9, 0.01, 0], [0, 0, 1.05, -0.02]])
    bent = np.concatenate([affine, [[0.1, -0.2], [-0.1, -0.2], [0.15, -0.3]]], axis=1)
    for some in (affine, bent):
        neutral = exposure.neutral(photo, some)
        back = 255 * reference.exposure_fwd(neutral / 255, some, photo)
        np.testing.assert_allclose(back, photo, atol=0.7)  # of 255: half a step of rounding, times the gains
