"""rasterization means what gsplat's function means, and agrees with render."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from clsplat import reference
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.rasterization import rasterization
from clsplat.render import render
from clsplat.testing import synthetic_scene

BACKGROUND = (0.2, 0.5, 0.9)


class Exported:
    """An array of another library: it has DLPack, and nothing else that NumPy reads."""

    def __init__(self, array: Any, device: tuple[int, int] = (1, 0)):
        self._array, self._device = array, device

    def __dlpack_device__(self) -> tuple[int, int]:
        return self._device

    def __dlpack__(self, **options: Any) -> Any:
        if self._device[0] != 1:
            raise BufferError("not in the memory of the host")
        return self._array.__dlpack__()


@pytest.fixture(scope="module")
def scene() -> tuple[Gaussians, list[Camera]]:
    gaussians, camera = synthetic_scene(60, seed=7)
    return gaussians.astype(np.float64), [camera, camera.translated(np.array([0.1, -0.05, 0.0]))]


def arguments(gaussians: Gaussians, cameras: list[Camera]) -> dict[str, Any]:
    return {
        "means": gaussians.means,
        "quats": gaussians.quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        "colors": gaussians.sh,
        "viewmats": np.stack([c.viewmat for c in cameras]),
        "Ks": np.stack([c.K for c in cameras]),
        "width": cameras[0].width,
        "height": cameras[0].height,
    }


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_it_agrees_with_render(scene: tuple[Gaussians, list[Camera]], device64: Device, mode: Any) -> None:
    gaussians, cameras = scene
    image, alpha, meta = rasterization(
        **arguments(gaussians, cameras),
        sh_degree=gaussians.sh_degree,
        backgrounds=[BACKGROUND] * 2,
        render_mode="RGB+ED",
        rasterize_mode=mode,
        device=device64,
    )
    assert meta["n_cameras"] == 2
    for i, camera in enumerate(cameras):
        expected = render(gaussians, camera, RenderConfig(mode=mode), device64, background=BACKGROUND, depth=True)
        # Logarithm and logit undo the activation to rounding.
        np.testing.assert_allclose(image[i, :, :, :3], expected.rgb, atol=1e-10)
        np.testing.assert_allclose(image[i, :, :, 3], expected.depth, atol=1e-9)
        np.testing.assert_allclose(alpha[i, :, :, 0], expected.alpha, atol=1e-10)


@pytest.mark.parametrize(("name", "model"), [("ortho", "orthographic"), ("fisheye", "fisheye")])
def test_it_takes_camera_models(
    scene: tuple[Gaussians, list[Camera]], device64: Device, name: Any, model: Any
) -> None:
    """By gsplat's names."""
    gaussians, cameras = scene
    coefficients = [[0.1, -0.02, 0.01, 0.0] if model == "fisheye" else [0.0] * 4] * 2
    images, _, _ = rasterization(
        **arguments(gaussians, cameras),
        sh_degree=gaussians.sh_degree,
        camera_model=name,
        radial_coeffs=coefficients,
        device=device64,
    )
    for image, camera in zip(images, cameras, strict=True):
        camera = replace(camera, model=model, distortion=tuple(coefficients[0]))
        expected = render(gaussians, camera, device=device64).rgb
        np.testing.assert_allclose(image, expected, atol=1e-10)  # as above
        assert (
            np.abs(
                image
                - render(gaussians, replace(camera, model="pinhole", distortion=(0,) * 4), device="reference").rgb
            ).max()
            > 0.1
        )


def test_lists_are_made_without_what_gradients_need(
    scene: tuple[Gaussians, list[Camera]], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[bool] = []
    bin_splats = reference.bin_splats

    def spy(*arguments: Any, gradients: bool = True) -> Any:
        asked.append(gradients)
        return bin_splats(*arguments, gradients=gradients)

    monkeypatch.setattr(reference, "bin_splats", spy)
    rasterization(**arguments(*scene), sh_degree=0, device="reference")
    assert asked == [False, False]


def test_every_render_mode(scene: tuple[Gaussians, list[Camera]]) -> None:
    given = arguments(scene[0], scene[1][:1]) | {"sh_degree": 0, "colors": scene[0].sh[:, :1]}
    images = {mode: rasterization(**given, render_mode=mode)[0] for mode in ("RGB", "D", "ED", "RGB+D", "RGB+ED")}
    alpha = rasterization(**given)[1]
    assert [images[m].shape[-1] for m in images] == [3, 1, 1, 4, 4]
    np.testing.assert_array_equal(images["RGB+D"][..., :3], images["RGB"])
    np.testing.assert_array_equal(images["RGB+D"][..., 3:], images["D"])
    covered = alpha > 0
    assert covered.any()
    np.testing.assert_allclose(images["ED"][covered], images["D"][covered] / alpha[covered])


@pytest.mark.parametrize("channels", [1, 2, 5])
def test_values_of_any_number_of_channels(
    scene: tuple[Gaussians, list[Camera]], device64: Device, channels: int
) -> None:
    gaussians, cameras = scene
    colors = np.random.default_rng(0).uniform(-1, 1, (len(gaussians), channels))
    given = arguments(gaussians, cameras) | {"colors": colors}
    image = rasterization(**given, device=device64)[0]
    assert image.shape[-1] == channels
    assert image.min() < 0  # values are not clamped as colours of spherical harmonics are
    np.testing.assert_allclose(image, rasterization(**given, device="reference")[0], atol=1e-10)
    per_camera = np.stack([colors, 2 * colors])
    np.testing.assert_allclose(
        rasterization(**(given | {"colors": per_camera}), device=device64)[0], image * [[[[1]]], [[[2]]]], atol=1e-12
    )


def test_meta_counts_and_places(scene: tuple[Gaussians, list[Camera]], device: Device) -> None:
    gaussians, cameras = scene
    given = arguments(gaussians, cameras) | {"colors": np.zeros((len(gaussians), 3))}
    given["means"] = gaussians.means.copy()
    given["means"][0] = cameras[0].position - 5 * cameras[0].viewmat[2, :3]  # behind both cameras
    meta = rasterization(**given, device=device)[2]
    assert (meta["tiles_per_gauss"][:, 0] == 0).all()
    assert (meta["radii"][:, 0] == 0).all()
    shown = meta["tiles_per_gauss"][0] > 0
    assert shown.sum() > 10
    homogeneous = given["means"] @ cameras[0].viewmat[:3, :3].T + cameras[0].viewmat[:3, 3]
    pixels = homogeneous @ cameras[0].K.T
    np.testing.assert_allclose(meta["means2d"][0][shown], (pixels[:, :2] / pixels[:, 2:])[shown], rtol=1e-4)
    np.testing.assert_allclose(meta["depths"][0][shown], homogeneous[shown, 2], rtol=1e-5)


def test_radii_of_huge_gaussians_are_positive(device: Device) -> None:
    K, one = np.array([[[300, 0, 50], [0, 300, 50], [0, 0, 1.0]]]), np.ones((1, 3))
    given = np.array([[0, 0, 1.0]]), np.array([[1.0, 0, 0, 0]]), 1e7 * one, np.array([0.9]), one, np.eye(4)[None], K
    meta = rasterization(*given, 100, 100, device=device)[2]
    assert (meta["radii"] > 10**9).all() and (meta["tiles_per_gauss"] > 0).all()


def test_opacities_and_scales_at_their_bounds(scene: tuple[Gaussians, list[Camera]], device: Device) -> None:
    gaussians, cameras = scene
    given = arguments(gaussians, cameras) | {"colors": np.ones((len(gaussians), 3))}
    given["opacities"] = np.where(np.arange(len(gaussians)) % 2, 1.0, 0.0)
    given["scales"] = gaussians.scales.copy()
    given["scales"][1] = 0
    image, alpha, meta = rasterization(**given, device=device)
    assert np.isfinite(image).all()
    assert np.isfinite(alpha).all()
    assert (meta["tiles_per_gauss"][:, ::2] == 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"means": np.zeros((0, 3))},
            "means, viewmats: expected at least one Gaussian and one camera, found 0 and 2",
        ),
        ({"means": np.zeros(3)}, r"means: expected shape \(any number, 3\), found \(3,\)"),
        ({"viewmats": np.eye(4)}, r"viewmats: expected shape \(any number, 4, 4\), found \(4, 4\)"),
        ({"Ks": np.eye(3)}, r"Ks: expected shape \(2, 3, 3\)"),
        ({"Ks": np.array([[[50, 2.0, 20], [0, 50, 20], [0, 0, 1]]] * 2)}, r"Ks: expected .* without skew"),
        (
            {"Ks": np.array([[[50, 0, 20], [0, 50, 20], [0, 0, 2.0]]] * 2)},
            r"Ks: expected .* divide by the last entry",
        ),
        ({"colors": np.ones((60, 3)), "sh_degree": 0}, r"colors: expected shape \(60, K, 3\) with K of 1, 4, 9, 16"),
        ({"quats": np.ones((3, 4))}, r"quats: expected shape \(60, 4\)"),
        ({"colors": np.ones((59, 3))}, r"colors: expected shape \(2, 60, 3\)"),
        ({"backgrounds": np.ones(3)}, r"backgrounds: expected shape \(2, 3\)"),
        ({"render_mode": "rgb"}, "render_mode: expected RGB"),
        ({"rasterize_mode": "antialised"}, "rasterize_mode: expected classic, antialiased, found 'antialised'"),
        ({"camera_model": "orthographic"}, "camera_model: expected pinhole, ortho, fisheye, found 'orthographic'"),
        ({"tile_size": 7}, "tile_size: expected 8, 16, 32, found 7"),
        ({"tile_size": 64}, "tile_size: expected 8, 16, 32, found 64"),
        ({"colors": np.ones((60, 0))}, "colors: expected 1 to 32 channels, found 0"),
        ({"colors": np.ones((2, 60, 33))}, "colors: expected 1 to 32 channels, found 33"),
        ({"scales": np.ones((60, 1))}, r"^scales: expected shape \(60, 3\), found \(60, 1\)"),
        ({"scales": np.full((60, 3), -2.0)}, r"scales: expected numbers of 0 or more, found -2.0; take exp\(\)"),
        ({"opacities": np.ones((60, 1))}, r"^opacities: expected shape \(60,\), found \(60, 1\)"),
        ({"opacities": np.linspace(0, 3, 60)}, "opacities: expected numbers from 0 to 1, found 0.0 to 3.0; take"),
        *(
            ({name: np.where(np.arange(60 * size).reshape(60, size) == 7, value, 0.5)}, f"^{name}: expected finite")
            for name, size, value in (("means", 3, np.nan), ("quats", 4, np.inf), ("colors", 3, -np.inf))
        ),
        ({"sh_degree": 4, "colors": np.zeros((60, 16, 3))}, "sh_degree: expected 0 to 3"),
        ({"sh_degree": 3.0, "colors": np.zeros((60, 16, 3))}, "sh_degree: expected an integer, found 3.0"),
    ],
)
def test_errors_name_the_argument(
    scene: tuple[Gaussians, list[Camera]], change: dict[str, Any], message: str
) -> None:
    given = arguments(*scene) | {"colors": np.ones((60, 3))} | change
    with pytest.raises(InputError, match=message):
        rasterization(**given)


def test_arrays_of_other_libraries_by_dlpack(scene: tuple[Gaussians, list[Camera]], device: Device) -> None:
    """Arguments that only have DLPack give the same bits, and results are shared by it."""
    given = arguments(*scene)
    given |= {"sh_degree": 3, "backgrounds": np.array([BACKGROUND] * 2), "device": device, "gradients": True}
    plain = rasterization(**given)
    exported = {name: Exported(a) if isinstance(a, np.ndarray) else a for name, a in given.items()}
    shared = rasterization(**exported)
    for one, other in zip(plain[:2], shared[:2], strict=True):
        np.testing.assert_array_equal(one, other)
        assert np.shares_memory(np.from_dlpack(other), other)
    v_render = np.ones(plain.render.shape)
    for one, other in zip(plain.backward(v_render), shared.backward(Exported(v_render)), strict=True):
        if one is not None:
            np.testing.assert_array_equal(one, other)
            assert np.shares_memory(np.from_dlpack(other), other)
    for name in ("means", "colors", "viewmats", "backgrounds"):
        with pytest.raises(
            InputError, match=f"{name}: expected an array in the memory of the host, .* found Exported"
        ):
            rasterization(**given | {name: Exported(given[name], device=(2, 0))})
    with pytest.raises(InputError, match="v_render: expected an array in the memory of the host"):
        plain.backward(Exported(v_render, device=(2, 0)))


@pytest.mark.parametrize("model", ["pinhole", "ortho"])
def test_normals_are_those_of_the_surface(
    scene: tuple[Gaussians, list[Camera]], device64: Device, model: Any
) -> None:
    gaussians, cameras = scene
    meta = rasterization(
        **arguments(gaussians, cameras), sh_degree=0, camera_model=model, normals=True, device=device64
    ).meta
    for i, camera in enumerate(cameras):
        kind: Any = "orthographic" if model == "ortho" else model
        surface = render(gaussians, replace(camera, model=kind), device=device64).surface()
        assert (surface.ids >= 0).any()
        np.testing.assert_allclose(meta["normals"][i], surface.normals, atol=1e-9)
        np.testing.assert_allclose(meta["median_depths"][i], surface.depth, atol=1e-9)
    assert "normals" not in rasterization(**arguments(gaussians, cameras), sh_degree=0, device=device64).meta
