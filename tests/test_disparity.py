"""Stage disparity: in numbers, against the twin, and gradients through an image by central differences."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.renderer import Pass, Renderer, download, fetch
from clsplat.stages import Image, SplatGrads, Splats
from clsplat.testing import assert_matches, gradcheck, synthetic_scene

# One pixel; less than, and more than what a work-item has, on a CPU.
SIZES = pytest.mark.parametrize(("height", "width"), [(1, 1), (5, 7), (64, 65)])


def tolerances_of(device: Device) -> Any:
    return DOUBLE if device.real == np.float64 else FLOAT


def compared(stages: Any, up: Any, image: Any, target: Any, v_rgb: Any) -> tuple[float, Any, Any]:
    """Loss, colours and gradients by the functions of a device or of the twin."""
    loss, rgb = stages.disparity_loss(up(image), up(target), 0.25)
    v_image = stages.disparity_grad(up(image), up(target), 0.25, up(v_rgb))
    return loss, *(a if isinstance(a, np.ndarray) else a.get() for a in (rgb, v_image))


def by_kernel(device: Device, *arrays: Any) -> tuple[float, Any, Any]:
    return compared(ops.Launches(device), partial(device.upload, "array"), *arrays)


def by_twin(*arrays: Any) -> tuple[float, Any, Any]:
    return compared(reference, lambda array: array, *arrays)


def test_in_numbers(any_device: Device) -> None:
    """Too near, too far, equal, and unknown: only the first two count, and colours pass unchanged."""
    image = np.array([[[1, 2, 3, 0.75], [4, 5, 6, 0.25], [7, 8, 9, 0.5], [1, 1, 1, 2]]], np.float64)
    target = np.array([[0.5, 1.0, 0.5, 0.0]])
    v_rgb = np.arange(12.0).reshape(1, 4, 3)
    for run in (by_twin, partial(by_kernel, any_device)):
        loss, rgb, v_image = run(image, target, v_rgb)
        assert loss == 0.25 * (0.25 + 0.75)
        np.testing.assert_array_equal(rgb, image[:, :, :3])
        np.testing.assert_array_equal(v_image[:, :, :3], v_rgb)
        np.testing.assert_array_equal(v_image[:, :, 3], [[0.25, -0.25, 0, 0]])


@SIZES
def test_matches_twin(configured_device: Device, height: int, width: int) -> None:
    rng = np.random.default_rng(height)
    target = rng.uniform(0, 1, (height, width)) * rng.choice([0, 1], (height, width), p=[0.25, 0.75])
    arrays = rng.uniform(0, 1, (height, width, 4)), target, rng.normal(size=(height, width, 3))
    # Exact in single precision, so that rounding changes no sign.
    arrays = tuple(a.astype(np.float32).astype(np.float64) for a in arrays)
    found, expected = by_kernel(configured_device, *arrays), by_twin(*arrays)
    for name, a, b in zip(("loss", "rgb", "v_image"), found, expected, strict=True):
        assert_matches(name, a, b, tolerances_of(configured_device))


def test_an_integer_is_a_weight(any_device: Device) -> None:
    rng = np.random.default_rng(0)
    image, target, v_rgb = (
        any_device.upload("arrays", a) for a in (rng.random((4, 5, 4)), rng.random((4, 5)), rng.random((4, 5, 3)))
    )
    found = [download(ops.disparity_grad(any_device, image, target, weight, v_rgb)) for weight in (2, 2.0)]
    np.testing.assert_array_equal(*found)
    assert np.abs(found[0][:, :, 3]).max() > 0.1


@pytest.mark.parametrize("n", [1, 65, 2000])
def test_inverse_depths_match_twin(any_device: Device, n: int) -> None:
    gaussians, camera = synthetic_scene(n, 0, width=160, height=120)
    gaussians.means[: n // 2 : 3] = camera.position  # invisible
    expected = reference.project_fwd(gaussians, camera, 3, channels=4)
    v_expected = SplatGrads(
        *(np.random.default_rng(1).normal(size=getattr(expected, k).shape) for k in SplatGrads._fields)
    )
    found = Splats(*(any_device.upload("splats", a) for a in expected))
    v_found = SplatGrads(*(any_device.upload("v_splats", a) for a in v_expected))
    ops.disparity_fwd(any_device, found)
    ops.disparity_bwd(any_device, found, v_found)
    reference.disparity_fwd(expected)
    reference.disparity_bwd(expected, v_expected)
    assert_matches("colors", found.colors.get(), expected.colors, tolerances_of(any_device))
    assert_matches("v_colors", v_found.colors.get(), v_expected.colors, tolerances_of(any_device))
    shown = expected.depths > 0
    np.testing.assert_allclose(expected.colors[shown, 3] * expected.depths[shown], 1)
    assert (expected.colors[~shown, 3] == 0).all() and (n < 65 or not shown.all())


@pytest.mark.parametrize("backdrop", [False, True], ids=["alone", "with a backdrop"])
def test_gradients_through_the_image(device64: Device, backdrop: bool) -> None:
    gaussians, camera = synthetic_scene(12, seed=2, margin=3e-2)
    others = synthetic_scene(5, seed=3, margin=3e-2)[0] if backdrop else None
    renderer = Renderer(device64, background=(0.1, 0.5, 0.9), backdrop=others)
    rng = np.random.default_rng(0)
    size = camera.height, camera.width
    weights, target = rng.normal(size=(*size, 3)), rng.uniform(0.5, 2, size) * rng.choice([0, 1], size)
    up = partial(device64.upload, "array")

    def run(**changed: Any) -> tuple[Pass, float]:
        arrays = {**gaussians.arrays(), **changed}
        result = renderer.forward(Gaussians(**arrays), camera, depth="inverse")
        loss, rgb = renderer.stages.disparity_loss(result.image.rgb, up(target), 0.05)
        return result, loss + float((rgb.get() * weights).sum())

    first = run()[0]
    off = np.abs(first.image.rgb.get()[:, :, 3] - target)[target > 0]
    assert off.min() > 1e-5, "the differences must not pass the kink"
    v_image = renderer.stages.disparity_grad(first.image.rgb, up(target), 0.05, up(weights))
    v = fetch(renderer.backward(first, Image(v_image, up(np.zeros(size)))).gaussians)
    checked = ("means", "log_scales", "quats", "logit_opacities")
    gradcheck(
        lambda **inputs: run(**inputs)[1],
        {name: gaussians.arrays()[name] for name in checked},
        {name: v.arrays()[name] for name in checked},
    )


def test_nothing_drawn_is_infinitely_far(device: Device) -> None:
    gaussians, camera = synthetic_scene(3, 0)
    gaussians.logit_opacities[:] = -20
    image = Renderer(device).forward(gaussians, camera, depth="inverse").image.rgb.get()
    assert image.shape[2] == 4 and (image[:, :, 3] == 0).all()
