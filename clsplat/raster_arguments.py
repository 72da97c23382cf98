"""The arguments of `rasterization`, checked: activated Gaussians, their values, and cameras."""

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera, CameraModel
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError, whole
from clsplat.gaussians import Gaussians, logit

CAMERA_MODELS: dict[str, CameraModel] = {"pinhole": "pinhole", "ortho": "orthographic", "fisheye": "fisheye"}
"""gsplat's names of camera models, and ours."""

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]

CHOICES: dict[str, tuple[Any, ...]] = {
    "tile_size": (8, 16, 32),
    "render_mode": get_args(RenderMode),
    "rasterize_mode": ("classic", "antialiased"),
    "camera_model": tuple(CAMERA_MODELS),
}
"""Values of the options that are names or sizes."""

COEFFICIENTS = tuple((degree + 1) ** 2 for degree in range(SH_DEGREE_MAX + 1))
"""Numbers of coefficients of spherical harmonics."""

INTRINSICS_TOLERANCE = 1e-6
"""Largest difference of entries of an intrinsic matrix from 0 or 1, where they have no other value, by rounding."""

CHANNELS_MAX = 32
"""Largest number of channels of the values."""


def on_host(name: str, array: Any) -> NDArray[Any]:
    """An argument as an array of NumPy, which shares the memory of what exports DLPack.

    Raises
    ------
    InputError
        If its memory is not the host's, or its library does not export it.
    """
    if isinstance(array, np.ndarray) or not hasattr(array, "__dlpack__"):
        return np.asarray(array)
    try:
        return np.from_dlpack(array)
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise InputError(
            f"{name}: expected an array in the memory of the host, which DLPack shares, found {type(array).__name__} "
            f"({error}); copy it to the host, and detach it from its gradients"
        ) from error


def arrays(**given: ArrayLike) -> list[NDArray[np.float64]]:
    """Arguments by name as arrays of NumPy. The kernels would leave out what is not finite, without a word."""
    found = [np.asarray(on_host(name, array), np.float64) for name, array in given.items()]
    for name, array in zip(given, found, strict=True):
        if not np.isfinite(array).all():
            raise InputError(f"{name}: expected finite numbers, found NaN or infinity")
    return found


def values_of(colors: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
    """The values of the cameras, of the shape (C, N, D)."""
    channels = colors.shape[-1] if colors.ndim else 0
    check_shape("colors", colors, (*shape, channels))
    if not 1 <= channels <= CHANNELS_MAX:
        raise InputError(
            f"colors: expected 1 to {CHANNELS_MAX} channels, found {channels}; rasterize more in several calls"
        )
    return colors


def behind_of(backgrounds: ArrayLike | None, shape: tuple[int, int]) -> NDArray[np.float64]:
    """The backgrounds of the cameras, of the shape (C, D)."""
    if backgrounds is None:
        return np.zeros(shape)
    (behind,) = arrays(backgrounds=backgrounds)
    check_shape("backgrounds", behind, shape)
    return behind


def exponents(quats: NDArray[np.float64]) -> NDArray[np.intc]:
    """Powers of two (N, 1) by which quaternions (N, 4) are divided so that their largest entry is from 1/2 to 1."""
    return np.asarray(np.frexp(np.abs(quats).max(axis=1, keepdims=True))[1])


def moderated(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quaternions (N, 4) divided by powers of two: their squares neither vanish nor overflow, and no bit changes."""
    return np.asarray(np.ldexp(quats, -exponents(quats)))


def gaussians_of(
    means: NDArray[Any],
    scales: NDArray[Any],
    quats: NDArray[Any],
    opacities: NDArray[Any],
    colors: NDArray[Any],
    sh_degree: int | None,
) -> Gaussians:
    """Gaussians from activated parameters, without spherical harmonics if `sh_degree` is None."""
    check_shape("quats", quats, (len(means), 4))
    check_shape("scales", scales, (len(means), 3))
    check_shape("opacities", opacities, (len(means),))
    if (scales < 0).any():
        raise InputError(f"scales: expected numbers of 0 or more, found {scales.min()}; take exp() of logarithms")
    if ((opacities < 0) | (opacities > 1)).any():
        raise InputError(
            f"opacities: expected numbers from 0 to 1, found {opacities.min()} to {opacities.max()}; take the "
            "sigmoid of logits"
        )
    sh = np.zeros((len(means), 1, 3)) if sh_degree is None else colors
    if sh.ndim != 3 or sh.shape[::2] != (len(means), 3) or sh.shape[1] not in COEFFICIENTS:
        raise InputError(
            f"colors: expected shape ({len(means)}, K, 3) with K of {', '.join(map(str, COEFFICIENTS))} for "
            f"sh_degree, found {sh.shape}"
        )
    with np.errstate(divide="ignore"):  # opacities 0 and 1, scales 0
        result = Gaussians(means, np.log(scales), quats.copy(), logit(opacities), sh).validate()
    if sh_degree is not None and not 0 <= whole("sh_degree", sh_degree) <= result.sh_degree:
        raise InputError(f"sh_degree: expected 0 to {result.sh_degree} (what colors hold), found {sh_degree}")
    return result


def cameras_of(
    viewmats: NDArray[Any],
    Ks: NDArray[Any],
    size: tuple[int, int],
    model: str,
    radial_coeffs: ArrayLike | None,
    near_plane: float | None,
) -> list[Camera]:
    """Cameras from gsplat's arguments."""
    count = len(viewmats)
    check_shape("Ks", Ks, (count, 3, 3))
    for K in Ks:
        skewed = np.abs(K - np.array([[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]))
        if (skewed > INTRINSICS_TOLERANCE).any():
            raise InputError(
                "Ks: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew, found "
                f"{K.tolist()}; divide by the last entry, and resample images with skew"
            )
    distortions = np.zeros((count, 4))
    if radial_coeffs is not None:
        (distortions,) = arrays(radial_coeffs=radial_coeffs)
    check_shape("radial_coeffs", distortions, (count, 4))
    if near_plane is not None and not 0 < near_plane < float("inf"):
        raise InputError(f"near_plane: expected a depth above 0, found {near_plane}")
    return [
        Camera(
            viewmat,
            *(K[0, 0], K[1, 1], K[0, 2], K[1, 2]),
            *size,
            CAMERA_MODELS[model],
            tuple(distortion.tolist()),
            near=near_plane,
        )
        for viewmat, K, distortion in zip(viewmats, Ks, distortions, strict=True)
    ]


def rows_of(name: str, array: NDArray[Any], each: tuple[int, ...]) -> int:
    """The number of rows of an array, which have the shape `each`."""
    rows = array.shape[0] if array.ndim else 1
    if array.shape != (rows, *each):
        raise InputError(f"{name}: expected shape (any number, {', '.join(map(str, each))}), found {array.shape}")
    return rows


def check_shape(name: str, array: NDArray[Any], expected: tuple[int, ...]) -> None:
    if array.shape != expected:
        raise InputError(f"{name}: expected shape {expected}, found {array.shape}")


def check_choices(**given: Any) -> None:
    for name, value in given.items():
        if value not in CHOICES[name]:
            raise InputError(f"{name}: expected {', '.join(map(str, CHOICES[name]))}, found {value!r}")
