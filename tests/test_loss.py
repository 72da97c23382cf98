"""Stage loss: against the twin, against scikit-image, against central differences, on masks and odd sizes."""

import numpy as np
import pytest
from device_opening import open_device
from skimage.metrics import structural_similarity
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.device import Device
from clsplat.testing import assert_matches, gradcheck

# (height, width): one pixel; smaller than the window; rows of whole vectors of 16 values, and of a fraction; three
# bands or more and two strips of 384 values; long and thin.
SIZES = [(1, 1), (3, 5), (16, 16), (33, 64), (29, 37), (131, 150), (3, 4099), (4099, 3)]


@pytest.fixture(
    scope="module",
    params=[(real, is_cpu) for real in (np.float64, np.float32) for is_cpu in (True, False)],
    ids=lambda p: f"{p[0].__name__}, as a {'CPU' if p[1] else 'GPU'}",
)
def each_device(request):
    """The device in both precisions, with the launches for CPUs and for GPUs, whatever it is."""
    real, is_cpu = request.param
    device = open_device(real)
    device.is_cpu = is_cpu  # shadows the cached property
    return device


def make_pair(height, width, seed=0):
    """An image, also outside [0, 1], and a photo that resembles it."""
    rng = np.random.default_rng(seed)
    i, j = np.mgrid[:height, :width]
    smooth = 0.5 + 0.4 * np.sin(0.3 * i + 0.5 * j)[:, :, None] * [1, -1, 0.5]
    image = smooth + rng.normal(0, 0.15, (height, width, 3))
    photo = np.clip(255 * (smooth + rng.normal(0, 0.05, (height, width, 3))), 0, 255).astype(np.uint8)
    return image.astype(np.float32).astype(np.float64), photo


def make_mask(height, width, seed=0):
    rng = np.random.default_rng(seed)
    return (rng.uniform(size=(height, width)) < 0.7).astype(np.uint8)


def on_device(device, image, photo, weight, mask=None):
    arrays = [device.upload("image", image), device.upload("photo", photo, np.uint8)]
    loss, v_image = ops.l1_ssim(
        device, *arrays, weight, None if mask is None else device.upload("mask", mask, np.uint8)
    )
    return float(loss), v_image.get()


def check(device, tolerances, image, photo, weight=0.2, mask=None):
    loss, v_image = on_device(device, image, photo, weight, mask)
    expected, v_expected = reference.l1_ssim(image, photo, weight, mask)
    assert_matches("loss", loss, expected, tolerances)
    assert_matches("v_image", v_image, v_expected, tolerances)


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
@pytest.mark.parametrize("size", SIZES, ids=str)
def test_matches_twin(each_device, size, masked):
    image, photo = make_pair(*size)
    tolerances = DOUBLE if each_device.real == np.float64 else FLOAT
    check(each_device, tolerances, image, photo, mask=make_mask(*size) if masked else None)


@pytest.mark.parametrize("weight", [0.0, 1.0])
def test_single_terms(each_device, weight):
    tolerances = DOUBLE if each_device.real == np.float64 else FLOAT
    check(each_device, tolerances, *make_pair(29, 37), weight)


@pytest.mark.parametrize("size", [(29, 37), (3, 5)], ids=str)
def test_ssim_is_that_of_scikit_image(device64, size):
    """Black borders wider than the window turn scikit-image's reflection into zero padding."""
    image, photo = make_pair(*size)
    wide = [np.pad(a, ((11, 11), (11, 11), (0, 0))) for a in (image, photo / 255)]
    options = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 1.0}
    _, ssim = structural_similarity(*wide, **options, channel_axis=2, full=True)
    expected = 1 - ssim[11:-11, 11:-11].mean()
    assert on_device(device64, image, photo, 1.0)[0] == pytest.approx(expected, rel=1e-12)
    assert reference.l1_ssim(image, photo, 1.0)[0] == pytest.approx(expected, rel=1e-12)


def test_l1_is_the_mean_over_all_values(each_device):
    image, photo = make_pair(29, 37)
    expected = np.abs(image - photo / 255).mean()
    assert on_device(each_device, image, photo, 0.0)[0] == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
@pytest.mark.parametrize("size", [(13, 21), (3, 5)], ids=str)
def test_central_differences(device64, size, masked):
    image, photo = make_pair(*size, seed=1)
    # L1 has a kink where image and photo agree.
    image = np.where(np.abs(image - photo / 255) < 1e-3, image + 2e-3, image)
    assert np.abs(image - photo / 255).min() > 5e-4
    mask = make_mask(*size) if masked else None

    def scalar(image):
        return on_device(device64, image, photo, 0.2, mask)[0]

    gradcheck(scalar, {"image": image}, {"image": on_device(device64, image, photo, 0.2, mask)[1]}, step=1e-5)


def test_masked_pixels_do_not_count(each_device):
    image, photo = make_pair(29, 37)
    mask = make_mask(29, 37)
    loss, v_image = on_device(each_device, image, photo, 0.2, mask)
    rng = np.random.default_rng(1)
    image[mask == 0], photo[mask == 0] = rng.normal(size=3), rng.integers(0, 256, 3)
    other_loss, v_other = on_device(each_device, image, photo, 0.2, mask)
    assert other_loss == loss
    np.testing.assert_array_equal(v_other, v_image)
    assert (v_image[mask == 0] == 0).all() and (v_image[mask == 1] != 0).all()


def test_equal_images(each_device):
    _, photo = make_pair(29, 37)
    loss, v_image = on_device(each_device, photo / 255, photo, 0.2)
    assert abs(loss) < 1e-6
    assert np.abs(v_image).max() * photo.size < 1e-3 + 1  # the sign of an L1 of rounding errors may be either
    black = np.zeros_like(photo)
    loss, v_image = on_device(each_device, black.astype(np.float64), black, 0.2)
    assert abs(loss) < 1e-6 and (v_image == 0).all()


@pytest.mark.parametrize("masked", [False, True], ids=["whole", "masked"])
def test_nothing_depends_on_uninitialised_memory(each_device, masked, monkeypatch):
    """The margins of the derivatives are written, and nothing beside or between them is read."""
    empty = Device.empty

    def filled(self, what, shape, dtype=None):
        array = empty(self, what, shape, dtype)
        array.fill(np.nan if array.dtype.kind == "f" else np.iinfo(array.dtype).max)
        return array

    monkeypatch.setattr(Device, "empty", filled)
    tolerances = DOUBLE if each_device.real == np.float64 else FLOAT
    for size in [(1, 1), (29, 37), (20, 32), (131, 150)]:
        check(each_device, tolerances, *make_pair(*size), mask=make_mask(*size) if masked else None)


def test_loss_of_four_megapixels(configured_device, device64):
    """Sums of 12 million terms in float32 lose little beyond the last digit."""
    image, photo = (np.tile(a, (8, 8, 1)) for a in make_pair(256, 256))
    expected = on_device(device64, image, photo, 0.2)[0]
    assert on_device(configured_device, image, photo, 0.2)[0] == pytest.approx(expected, rel=3e-7)


def test_same_bits_twice(each_device):
    image, photo = make_pair(140, 70)
    first, second = (on_device(each_device, image, photo, 0.2) for _ in range(2))
    assert first[0] == second[0]
    np.testing.assert_array_equal(first[1], second[1])
