"""The gradients of rasterization against central differences, for features, harmonics, depths and cameras."""

import gc
from typing import Any
from weakref import ref

import numpy as np
import pytest
from test_rasterization import arguments

from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.rasterization import rasterization
from clsplat.testing import synthetic_scene

STEP = 1e-6

GIVEN = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")


@pytest.fixture(scope="module")
def given() -> dict[str, Any]:
    gaussians, camera = synthetic_scene(12, seed=5)
    gaussians = gaussians.astype(np.float64)
    return arguments(gaussians, [camera, camera.translated(np.array([0.1, -0.05, 0.0]))])


def with_colors(given: dict[str, Any], channels: int | None) -> dict[str, Any]:
    """Arguments with values of some channels, or spherical harmonics for None."""
    rng = np.random.default_rng(1)
    backgrounds = rng.uniform(size=(2, channels or 3))
    if channels is None:
        return given | {"sh_degree": 3, "backgrounds": backgrounds}
    return given | {"colors": rng.normal(size=(len(given["means"]), channels)), "backgrounds": backgrounds}


@pytest.mark.parametrize(
    ("channels", "mode", "rasterize_mode"),
    [
        (1, "RGB", "classic"),
        (5, "RGB+D", "antialiased"),
        (32, "RGB", "classic"),
        (None, "RGB", "classic"),
        (None, "RGB+ED", "antialiased"),
        (3, "ED", "classic"),
        (3, "D", "classic"),
    ],
)
def test_gradients_are_those_of_differences(
    given: dict[str, Any], device64: Device, channels: int | None, mode: Any, rasterize_mode: Any
) -> None:
    inputs = with_colors(given, channels) | {"render_mode": mode, "rasterize_mode": rasterize_mode}
    rng = np.random.default_rng(2)
    result = rasterization(**inputs, device=device64, gradients=True)
    v_render, v_alpha = (rng.normal(size=array.shape) for array in result[:2])
    v = result.backward(v_render, v_alpha)

    def loss(name: str, array: Any) -> float:
        image, alpha, _ = rasterization(**(inputs | {name: array}), device=device64)
        return float((image * v_render).sum() + (alpha * v_alpha).sum())

    for name in GIVEN:
        array = np.asarray(inputs[name], np.float64)
        gradient = getattr(v, name)
        assert gradient.shape == array.shape, name
        direction = rng.normal(size=array.shape)
        if name == "viewmats":
            direction[:, 3] = 0
        if name == "Ks":
            direction *= [[1, 0, 1], [0, 1, 1], [0, 0, 0]]
        if name == "quats":  # of the norm, which has no gradient, only what changes the direction
            direction -= (
                array * (direction * array).sum(axis=1, keepdims=True) / (array**2).sum(axis=1, keepdims=True)
            )
        difference = (loss(name, array + STEP * direction) - loss(name, array - STEP * direction)) / (2 * STEP)
        slope = (gradient * direction).sum()
        np.testing.assert_allclose(
            slope, difference, rtol=2e-5, atol=1e-5 * np.abs(v_render).sum() ** 0.5, err_msg=name
        )
    assert np.abs(v.means2d).max() > 0 and v.means2d.shape == (2, 12, 2)


@pytest.mark.parametrize("power", [-100, 100])
def test_quaternions_of_any_norm(given: dict[str, Any], device: Device, power: int) -> None:
    """A power of two changes no bit of the image, and divides the gradients."""
    inputs = with_colors(given, 3)
    plain, scaled = (
        rasterization(**(inputs | {"quats": factor * given["quats"]}), gradients=True, device=device)
        for factor in (1.0, 2.0**power)
    )
    np.testing.assert_array_equal(scaled.render, plain.render)
    v_render = np.ones(plain.render.shape)
    np.testing.assert_array_equal(scaled.backward(v_render).quats, plain.backward(v_render).quats / 2.0**power)


def test_values_of_each_camera_have_gradients_of_their_own(given: dict[str, Any], device64: Device) -> None:
    inputs = with_colors(given, 4)
    v_render = np.random.default_rng(3).normal(size=(2, given["height"], given["width"], 4))
    together = rasterization(**inputs, device=device64, gradients=True).backward(v_render).colors
    inputs["colors"] = np.stack([inputs["colors"]] * 2)
    result = rasterization(**inputs, device=device64, gradients=True)
    apart = result.backward(v_render).colors
    assert apart.shape == (2, 12, 4)
    np.testing.assert_allclose(apart.sum(axis=0), together)
    v_render[1] = 0
    assert not result.backward(v_render).colors[1].any()


def test_reference_and_device_agree(given: dict[str, Any], device64: Device) -> None:
    inputs = with_colors(given, 7)
    v = []
    for device in (device64, "reference"):
        result = rasterization(**inputs, device=device, gradients=True)  # type: ignore[arg-type]
        v_render = np.cos(np.arange(result.render.size)).reshape(result.render.shape)
        v.append(result.backward(v_render, absgrad=True))
    for one, other in zip(*v, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-8 * max(1, np.abs(other).max()))


def test_absolute_gradients_are_those_of_what_was_composited(given: dict[str, Any], device64: Device) -> None:
    """At least the absolute values of the gradients, in each camera; only if they are asked for."""
    result = rasterization(**with_colors(given, 5) | {"render_mode": "RGB+ED"}, device=device64, gradients=True)
    v_render = np.random.default_rng(3).normal(size=result.render.shape)
    v = result.backward(v_render, absgrad=True)
    assert v.absgrad is not None and v.absgrad.shape == v.means2d.shape == (2, 12, 2)
    assert (v.absgrad >= np.abs(v.means2d) * (1 - 1e-9)).all() and (v.absgrad > 1.5 * np.abs(v.means2d)).any()
    assert result.backward(v_render).absgrad is None


def test_opacities_and_scales_at_their_bounds_have_finite_gradients(given: dict[str, Any], device: Device) -> None:
    inputs = with_colors(given, 3)
    inputs["opacities"] = np.where(np.arange(12) % 2, 1.0, 0.0)
    inputs["scales"] = np.array(given["scales"])
    inputs["scales"][1] = 0
    result = rasterization(**inputs, device=device, gradients=True)
    v = result.backward(np.ones(result.render.shape), absgrad=True)
    assert all(np.isfinite(array).all() for array in v)
    assert not v.opacities.any() and not v.scales[1].any()


def test_a_near_plane_hides_what_is_nearer(given: dict[str, Any], device: Device) -> None:
    inputs = with_colors(given, 3)
    depths = rasterization(**inputs, device=device).meta["depths"][0]
    near = float(np.median(depths[depths > 0]))
    meta = rasterization(**inputs, near_plane=near, device=device).meta
    np.testing.assert_array_equal(meta["radii"][0].any(axis=1), (depths > near))
    assert 0 < (depths > near).sum() < 12


def test_small_splats_are_clipped(given: dict[str, Any], device: Device) -> None:
    inputs = with_colors(given, 3) | {"scales": given["scales"] * np.linspace(0.01, 1, 12)[:, None]}
    radii = rasterization(**inputs, device=device).meta["radii"][0].max(axis=1)
    clip = int(np.median(radii))  # radii are rounded up
    result = rasterization(**inputs, radius_clip=clip, device=device, gradients=True)
    shown = result.meta["radii"][0].any(axis=1)
    np.testing.assert_array_equal(shown, radii > clip)
    assert 0 < shown.sum() < 12
    v = result.backward(np.ones(result.render.shape)[:1].repeat(2, axis=0))
    hidden = ~result.meta["radii"].any(axis=(0, 2))
    assert hidden.any() and not v.means[hidden].any()


def test_eps2d_is_the_variance_that_is_added(given: dict[str, Any], device64: Device) -> None:
    inputs = with_colors(given, 3)
    covariances = []
    for eps2d in (0.3, np.float64(0.8)):
        meta = rasterization(**inputs, eps2d=eps2d, device=device64).meta
        xx, xy, yy = meta["conics"][0][meta["radii"][0].any(axis=1)].T
        covariances.append(np.linalg.inv(np.array([[xx, xy], [xy, yy]]).transpose(2, 0, 1)))
    np.testing.assert_allclose(
        covariances[1] - covariances[0], np.broadcast_to(0.5 * np.eye(2), covariances[0].shape), atol=1e-9
    )


def test_eps2d_keeps_the_model_of_the_device(given: dict[str, Any]) -> None:
    inputs = with_colors(given, 3) | {"opacities": np.full(12, 0.5)}
    faint = Device(model={"ALPHA_MIN": 0.6})
    assert not rasterization(**inputs, eps2d=0.5, device=faint).alpha.any()


def test_eps2d_opens_one_device_that_ends_with_the_given_one(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: list[Any] = []
    create = Device.__init__
    monkeypatch.setattr(Device, "__init__", lambda d, *a: opened.append(ref(d)) or create(d, *a))
    device = Device()
    for eps2d in (0.5, 0.5, 0.8):
        rasterization(**with_colors(given, 3), eps2d=eps2d, device=device)
    gc.collect()
    assert [d() is not None for d in opened] == [True, False, True]  # the given one, 0.5 and 0.8
    del device
    gc.collect()
    assert not any(d() for d in opened)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"near_plane": 0.0}, "near_plane: expected a depth above 0, found 0"),
        ({"radius_clip": -1.0}, "radius_clip: expected a number, 0 or more"),
        ({"eps2d": 0.0}, "eps2d: expected a number above 0"),
        ({"eps2d": 0.5, "device": "reference"}, "on the reference 0.3, found 0.5"),
    ],
)
def test_errors_name_the_argument(given: dict[str, Any], change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        rasterization(**(with_colors(given, 3) | change))


class SmallMemory:
    """A device with the least local memory that OpenCL demands."""

    local_mem_size = 32 << 10

    def __init__(self, device: Any):
        self._device = device

    def __getattr__(self, name: str) -> Any:
        return getattr(self._device, name)


@pytest.mark.parametrize(("tile_size", "fitting"), [(16, 29), (32, 5)])
def test_tiles_that_exceed_the_local_memory_are_refused(
    given: dict[str, Any], monkeypatch: pytest.MonkeyPatch, tile_size: Any, fitting: int
) -> None:
    device = Device()
    monkeypatch.setattr(device, "is_cpu", False)
    assert device.subgroup_size >= 0  # asked before the device is replaced
    monkeypatch.setattr(device, "cl_device", SmallMemory(device.cl_device))
    options: dict[str, Any] = {"tile_size": tile_size, "gradients": True, "device": device}
    result = rasterization(**with_colors(given, fitting), **options)
    assert result.backward(np.ones(result.render.shape)).means.any()
    refused = rf"^tile_size: gradients of {fitting + 1} channels in tiles of {tile_size} px need 32772 bytes"
    monkeypatch.setattr(device, "launch", None)  # it is refused before the forward pass
    for inputs in (
        with_colors(given, fitting + 1),
        with_colors(given, fitting) | {"render_mode": "RGB+D"},
    ):
        with pytest.raises(DeviceError, match=refused + ".* has 32768; use smaller tiles or fewer channels"):
            rasterization(**inputs, **options)


def test_what_backward_refuses(given: dict[str, Any], device: Device) -> None:
    inputs = with_colors(given, 3)
    with pytest.raises(InputError, match="made with gradients=True"):
        rasterization(**inputs, device=device).backward(np.zeros(1))
    result = rasterization(**inputs, device=device, gradients=True)
    with pytest.raises(InputError, match=r"v_render: expected shape \(2, 29, 37, 3\), found \(1,\)"):
        result.backward(np.zeros(1))
    with pytest.raises(InputError, match="v_alpha: expected shape"):
        result.backward(np.zeros(result.render.shape), np.zeros(3))
