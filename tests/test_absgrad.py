"""Stage absgrad: against the twin, against sums of gradients of single pixels, and where signs cancel."""

from typing import Any

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.stages import AnySplats, Image, Splats
from clsplat.testing import assert_matches, synthetic_scene

BACKGROUND = (0.2, 0.5, 0.8)


def inputs(n: int, tile: int, real: Any, opaque: float = 0.0) -> tuple[Splats, Image, Image]:
    """Splats, their image and its gradients, as the device has them, for a camera of 37 x 29 pixels."""
    gaussians, camera = synthetic_scene(n, 1, width=37, height=29, margin=1e-3)
    gaussians.logit_opacities[:] += opaque
    gaussians.log_scales[:] += opaque / 3
    splats = Splats(*(np.asarray(a, real).astype(float) for a in reference.project_fwd(gaussians, camera, 3)))
    image = reference.composite_fwd(splats, reference.bin_splats(splats, 37, 29, tile), BACKGROUND)
    rng = np.random.default_rng(0)
    pairs = image, Image(*(rng.normal(size=a.shape) for a in image))
    return splats, *(Image(*(a.astype(real).astype(float) for a in pair)) for pair in pairs)  # type: ignore[return-value]


def by_kernel(device: Device, splats: Splats, tile: int, image: Image, v_image: Image) -> Any:
    placed = Splats(*(device.upload("splats", a) for a in splats))
    bins = ops.bin_splats(device, placed, 37, 29, tile)
    pairs = (Image(*(device.upload("image", a) for a in pair)) for pair in (image, v_image))
    return ops.absgrad(device, placed, bins, *pairs).get()


@pytest.mark.parametrize("tile", [8, 16, 32])
@pytest.mark.parametrize(("n", "opaque"), [(1, 0.0), (40, 0.0), (80, 3.0)])
def test_matches_twin(any_device: Device, n: int, opaque: float, tile: int) -> None:
    """Also where pixels stop, and alphas are clamped."""
    splats, image, v_image = inputs(n, tile, any_device.real, opaque)
    expected = reference.absgrad(splats, reference.bin_splats(splats, 37, 29, tile), image, v_image)
    found = by_kernel(any_device, splats, tile, image, v_image)
    assert_matches("v_means2d", found, expected, DOUBLE if any_device.real == np.float64 else FLOAT)
    assert (expected > 0).any()
    if opaque:
        hidden = (expected == 0).all(axis=1) & (splats.extents[:, 0] > 0)
        assert hidden.any(), "some splats lie behind where all pixels stop"


def test_it_is_the_sum_of_the_gradients_of_single_pixels() -> None:
    """And at least the absolute value of the gradient."""
    splats, image, v_image = inputs(12, 64, np.float64)
    bins = reference.bin_splats(splats, 37, 29, 64)
    expected = np.zeros((12, 2))
    for y in range(29):
        for x in range(37):
            rgb, alpha = np.zeros(v_image.rgb.shape), np.zeros(v_image.alpha.shape)
            rgb[y, x], alpha[y, x] = v_image.rgb[y, x], v_image.alpha[y, x]
            expected += np.abs(reference.composite_bwd(splats, bins, image, Image(rgb, alpha)).means2d)
    found = reference.absgrad(splats, bins, image, v_image)
    np.testing.assert_allclose(found, expected, rtol=1e-9)
    signed = np.abs(reference.composite_bwd(splats, bins, image, v_image).means2d)
    assert (found >= signed * (1 - 1e-12)).all() and (found > 1.1 * signed).any()


def test_signs_do_not_cancel(device64: Device) -> None:
    """A disc that should become larger on all sides has no gradient by its centre."""
    arrays = {
        "means2d": [[18.5, 14.5]],
        "conics": [[0.05, 0, 0.05]],
        "depths": [1.0],
        "extents": [[14.0, 14.0]],
        "opacities": [0.5],
        "colors": [[1.0, 1.0, 1.0]],
    }
    splats = Splats(**{name: np.array(array) for name, array in arrays.items()})
    bins = reference.bin_splats(splats, 37, 29, 16)
    image = reference.composite_fwd(splats, bins, (0.0, 0.0, 0.0))
    v_image = Image(-np.ones(image.rgb.shape), np.zeros(image.alpha.shape))
    signed = reference.composite_bwd(splats, bins, image, v_image).means2d
    found = by_kernel(device64, splats, 16, image, v_image)
    assert np.abs(signed).max() < 1e-12 and found.min() > 1


def test_values_that_are_not_finite_have_none(any_device: Device) -> None:
    splats, image, v_image = inputs(40, 16, any_device.real)
    v_image.rgb[10, 10] = np.nan
    for found in (
        by_kernel(any_device, splats, 16, image, v_image),
        reference.absgrad(splats, reference.bin_splats(splats, 37, 29, 16), image, v_image),
    ):
        assert np.isfinite(found).all() and (found > 0).any()


@pytest.mark.parametrize("axis", [0, 1])
def test_a_sum_that_overflows_in_one_axis_has_none(device: Device, axis: int) -> None:
    """A splat that is narrow along one axis: the sum is beyond single precision along this axis alone."""
    conic = np.array([1e-6, 0, 1e-6])
    conic[2 * axis] = 0.05
    arrays = ([[18.5, 14.5]], [conic], [1.0], [[60.0, 60.0]], [0.5], [[1.0, 0.0, 0.0]])
    splats = Splats(*map(np.array, arrays))
    image = reference.composite_fwd(splats, reference.bin_splats(splats, 37, 29, 16), (0.0, 0.0, 0.0))
    v_image = Image(np.full(image.rgb.shape, 3e37), np.zeros(image.alpha.shape))
    expected = reference.absgrad(splats, reference.bin_splats(splats, 37, 29, 16), image, v_image)[0]
    assert expected[axis] > np.finfo(np.float32).max > 10 * expected[1 - axis] > 0
    np.testing.assert_array_equal(by_kernel(device, splats, 16, image, v_image), [[0, 0]])


def test_what_it_refuses(device: Device) -> None:
    splats, image, v_image = inputs(5, 16, np.float32)
    placed: AnySplats = Splats(*(device.upload("splats", a) for a in splats))
    without = ops.bin_splats(device, placed, 37, 29, 16, gradients=False)
    with pytest.raises(InputError, match="lists made with gradients=True"):
        ops.absgrad(device, placed, without, image, v_image)
    gaussians, camera = synthetic_scene(5, 1, width=37, height=29)
    along = ops.project_fwd(
        device, Gaussians(**{k: device.upload(k, a) for k, a in gaussians.arrays().items()}), camera, 0, rays=True
    )
    with pytest.raises(InputError, match="those of the affine projection"):
        ops.absgrad(device, along, ops.bin_splats(device, along, 37, 29, 16), image, v_image)
