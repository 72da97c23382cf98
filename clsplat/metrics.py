"""Image metrics as the field reports them: PSNR, SSIM and, if installed, FLIP and LPIPS.

Images are (H, W, 3), uint8 or floats in [0, 1]. Floats are first rounded to 8 bits, the precision of photos and of
saved renders. The metric of a scene is the mean over its images, not the metric of the mean error.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SSIM_C1, SSIM_C2, SSIM_SIGMA, SSIM_WINDOW
from clsplat.errors import InputError

Array = NDArray[Any]


def to_uint8(image: Array) -> NDArray[np.uint8]:
    """Round an image (H, W, 3) to 8 bits. Floats are clamped to [0, 1]; uint8 is returned unchanged.

    Raises
    ------
    InputError
        If the shape is not (H, W, 3), the dtype is neither uint8 nor float, or a value is not finite.
    """
    if image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise InputError(f"image: expected shape (H, W, 3), found {image.shape}")
    if image.dtype == np.uint8:
        return image
    if not np.issubdtype(image.dtype, np.floating):
        raise InputError(f"image: expected uint8 or floats in [0, 1], found {image.dtype}")
    if not np.isfinite(image).all():
        raise InputError("image: expected finite values, found NaN or infinity")
    return np.rint(np.clip(image, 0, 1) * 255).astype(np.uint8)


def psnr(image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> float:
    """Peak signal-to-noise ratio over all pixels and channels.

    Parameters
    ----------
    image, truth : (H, W, 3) uint8 or float in [0, 1]
    mask : (H, W) bool, optional
        True where pixels count.

    Returns
    -------
    float
        PSNR, dB. Infinite for equal images.

    Raises
    ------
    InputError
        If the shapes differ, a value is not finite, or the mask leaves no pixel.
    """
    a, b, mask = _prepare(image, truth, mask)
    mse = float(np.mean((a - b)[mask] ** 2))
    return -10 * math.log10(mse) if mse > 0 else math.inf


def psnr_fitted(image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> float:
    """PSNR after the affine map of the image's colours that brings the image closest to the truth.

    This metric ignores changes that a photo's exposure and white balance make to all pixels alike, and that no
    training could predict. Martin-Brualla et al. 2021 and Barron et al. 2022 fit held-out photos in a similar way.

    Parameters, result and errors are those of `psnr`. Up to rounding and clamping, the result is at least `psnr`.
    """
    a, b, mask = _prepare(image, truth, mask)
    return psnr(colors_fitted(a, b, mask), b, mask)


def colors_fitted(image: Array, truth: Array, mask: NDArray[np.bool_]) -> Array:
    """Map the colours of an image (H, W, 3) by the affine map that brings its pixels closest to the truth.

    The mask names the pixels that count. Images are floats; the result is neither rounded nor clamped.
    """
    inputs, outputs = np.c_[image[mask], np.ones(mask.sum())], truth[mask]
    # Normal equations: 4 unknowns per channel, many pixels. The pseudo-inverse also handles flat images.
    fit: Array = np.linalg.pinv(inputs.T @ inputs) @ (inputs.T @ outputs)
    return image @ fit[:3] + fit[3]


def ssim(image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> float:
    """Structural similarity (Wang et al. 2004, doi:10.1109/TIP.2003.819861), mean over all pixels and channels.

    The window is a Gaussian of 11x11 px with sigma 1.5 px. Variances are population variances. Borders are padded
    with zeros, as in the training loss of the original code; scikit-image mirrors them instead.

    Parameters
    ----------
    image, truth : (H, W, 3) uint8 or float in [0, 1]
    mask : (H, W) bool, optional
        True where pixels count. Elsewhere, windows contain the pixels of the truth for both images.

    Returns
    -------
    float
        SSIM, at most 1; 1 for equal images.

    Raises
    ------
    InputError
        As `psnr`.
    """
    from scipy.ndimage import correlate1d

    a, b, mask = _prepare(image, truth, mask)
    offsets = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    window = np.exp(-(offsets**2) / (2 * SSIM_SIGMA**2))
    window /= window.sum()

    def blur(x: Array) -> Array:
        return correlate1d(correlate1d(x, window, axis=0, mode="constant"), window, axis=1, mode="constant")

    mu_a, mu_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mu_a**2, blur(b * b) - mu_b**2
    cov = blur(a * b) - mu_a * mu_b
    luminance = (2 * mu_a * mu_b + SSIM_C1) / (mu_a**2 + mu_b**2 + SSIM_C1)
    structure = (2 * cov + SSIM_C2) / (var_a + var_b + SSIM_C2)
    return float(np.mean((luminance * structure)[mask]))


def flip(image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> float | None:
    """Mean FLIP error (Andersson et al. 2020, doi:10.1145/3406183) at its default of 67 pixels per degree.

    Parameters
    ----------
    image, truth : (H, W, 3) uint8 or float in [0, 1]
    mask : (H, W) bool, optional
        True where pixels count.

    Returns
    -------
    float or None
        FLIP, 0 to 1; 0 for equal images. None if the package flip-evaluator is not installed.

    Raises
    ------
    InputError
        As `psnr`.
    """
    a, b, mask = _prepare(image, truth, mask)
    try:
        import flip_evaluator
    except ImportError:
        return None
    errors, _, _ = flip_evaluator.evaluate(
        b.astype(np.float32), a.astype(np.float32), "LDR", applyMagma=False, computeMeanError=False
    )
    return float(np.mean(errors[..., 0][mask], dtype=np.float64))


def lpips(image: Array, truth: Array, mask: NDArray[np.bool_] | None = None) -> float:
    """LPIPS distance by the features of AlexNet (Zhang et al. 2018, version 0.1), as the package lpips computes it.

    The package imports torch. Nothing is downloaded: the weights of AlexNet must be in torch's cache.

    Parameters
    ----------
    image, truth : (H, W, 3) uint8 or float in [0, 1]
    mask : (H, W) bool, optional
        True where pixels count.

    Returns
    -------
    float
        0 for equal images.

    Raises
    ------
    InputError
        As `psnr`; if the package lpips is not installed, or the weights are missing.
    """
    a, b, mask = _prepare(image, truth, mask)
    network, tensor = lpips_network(not mask.all())
    first, second = (tensor(np.float32(2 * x - 1).transpose(2, 0, 1)[None].copy()) for x in (a, b))
    found = np.asarray(network(first, second).detach().numpy(), np.float64)
    return float(found.ravel()[0]) if mask.all() else float(found[0, 0][mask].mean())


@cache
def lpips_network(spatial: bool) -> tuple[Any, Any]:
    """The network of `lpips`, with a distance per pixel if `spatial`, and the function that makes tensors of arrays.

    Raises
    ------
    InputError
        If the package or the weights are missing.
    """
    try:
        import lpips as package
        import torch
    except ImportError as error:
        raise InputError(
            f"lpips: expected the package lpips, found none ({error}); pip install 'clsplat[lpips]'"
        ) from error
    folder = Path(torch.hub.get_dir()) / "checkpoints"
    if not any(folder.glob("alexnet-owt-*.pth")):
        raise InputError(
            f"lpips: expected the weights of AlexNet, alexnet-owt-*.pth, in {folder}, found none; "
            "torchvision.models.alexnet(weights='DEFAULT') downloads them"
        )
    return package.LPIPS(net="alex", spatial=spatial, verbose=False).eval(), torch.from_numpy


def _prepare(image: Array, truth: Array, mask: NDArray[np.bool_] | None) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Both images, rounded to 8 bits, as float64 in [0, 1], and the mask. Where it is False, the images are equal."""
    a, b = to_uint8(image) / 255, to_uint8(truth) / 255
    if a.shape != b.shape:
        raise InputError(f"image: expected the truth's shape {b.shape}, found {a.shape}")
    if mask is None:
        mask = np.ones(a.shape[:2], dtype=bool)
    if mask.shape != a.shape[:2] or mask.dtype != bool:
        raise InputError(f"mask: expected bool of shape {a.shape[:2]}, found {mask.dtype} of shape {mask.shape}")
    if not mask.any():
        raise InputError("mask: expected at least one pixel that counts, found none")
    return np.where(mask[..., None], a, b), b, mask
