"""Building blocks for tests of kernels and plug-ins.

They are scenes that keep a distance from every threshold, a check of gradients by central differences, and a
comparison of arrays by a table of tolerances.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    COMPENSATION_MIN,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_MIN,
)
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians, sigmoid
from clsplat.reference import project_fwd
from clsplat.reference.lens import lens
from clsplat.reference.sh import sh_basis
from clsplat.stages import AnySplats

Array = NDArray[Any]

# Largest number of draws. With a margin of 1e-3 a draw violates it in about one row of eight, so 40 draws suffice.
DRAWS_MAX = 40


class Tolerance(NamedTuple):
    """Tolerance |actual - expected| <= rtol |expected| + atol max|expected|, and the reason for it."""

    rtol: float
    atol: float
    why: str


def assert_matches(
    quantity: str,
    actual: Any,
    expected: Any,
    tolerances: Mapping[str, Tolerance],
    where: Array | None = None,
) -> None:
    """Compare an array with the expected one, by the tolerance of its quantity.

    Parameters
    ----------
    quantity : str
        Key of `tolerances`, and name of the array in the error.
    actual, expected : arrays of one shape
    tolerances : mapping of quantity to Tolerance
    where : array of bool, optional
        Entries to compare, as an index of the leading axes. Default: all.

    Raises
    ------
    AssertionError
        If the shapes differ, a value is not finite, or an entry exceeds the tolerance. The message names the worst
        entry, its error, and the reason for the tolerance.
    """
    actual, expected = np.asarray(actual), np.asarray(expected)
    assert actual.shape == expected.shape, f"{quantity}: expected shape {expected.shape}, found {actual.shape}"
    if where is not None:
        actual, expected = actual[where], expected[where]
    assert np.isfinite(expected).all(), f"{quantity}: the expected values are not finite"
    assert np.isfinite(actual).all(), f"{quantity}: {(~np.isfinite(actual)).sum()} values are not finite"
    if expected.size == 0:
        return
    rtol, atol, why = tolerances[quantity]
    error = np.abs(actual.astype(np.float64) - expected)
    scale = np.abs(expected).max()
    excess = error - rtol * np.abs(expected) - atol * scale
    worst = np.unravel_index(np.argmax(excess), excess.shape)
    assert excess[worst] <= 0, (
        f"{quantity}{list(map(int, worst))}: expected {expected[worst]:.9g}, found {actual[worst]:.9g}; "
        f"{(excess > 0).sum()} of {excess.size} differ by more than {rtol:g} of the value + {atol:g} of the largest, "
        f"{scale:.3g} ({why})"
    )


def gradcheck(
    function: Callable[..., float],
    inputs: Mapping[str, Array],
    gradients: Mapping[str, Array],
    *,
    step: float = 1e-6,
    rtol: float = 1e-6,
    seed: int = 0,
) -> None:
    """Compare gradients with central differences, along three random directions and at six entries of each input.

    Parameters
    ----------
    function : callable
        ``function(**inputs)`` computes the differentiated scalar in float64.
    inputs : mapping of name to float64 array
        Values of the order of 1. `function` must be smooth within a few `step` of them.
    gradients : mapping of name to array
        Gradients with respect to inputs[name], of the same shape. Inputs without a gradient are held fixed.
    step : float
        Step of the differences. Their rounding error is about 1e-16/step, their truncation error about step^2.
    rtol : float
        Largest relative error. Along directions it is relative to the norm of the gradient; at entries, to the root
        mean square of the gradient or to the entry, whichever is larger.
    seed : int
        Seed of the directions and entries. Half of the entries are those with the largest gradients.

    Raises
    ------
    AssertionError
        If a gradient exceeds the tolerance. The message names the input and both values.
    """
    rng = np.random.default_rng(seed)
    for name, gradient in gradients.items():
        x, v = np.asarray(inputs[name], dtype=np.float64), np.asarray(gradient, dtype=np.float64)
        assert v.shape == x.shape, f"v_{name}: expected shape {x.shape}, found {v.shape}"
        assert np.isfinite(v).all(), f"v_{name}: {(~np.isfinite(v)).sum()} values are not finite"
        largest = np.argsort(np.abs(v), axis=None)[::-1][:3]
        entries = np.concatenate([largest, rng.integers(x.size, size=3)])
        probes = [(f"direction {k}", rng.normal(size=x.shape), float(np.linalg.norm(v))) for k in range(3)]
        rms = float(np.sqrt(np.mean(v**2)))
        for entry in entries:
            unit = np.zeros(x.size)
            unit[entry] = 1
            place = f"entry {list(map(int, np.unravel_index(entry, x.shape)))}"
            probes.append((place, unit.reshape(x.shape), max(rms, abs(float(v.flat[entry])))))
        for place, direction, scale in probes:
            values = [function(**{**inputs, name: x + sign * step * direction}) for sign in (1, -1)]
            difference = (values[0] - values[1]) / (2 * step)
            analytic = float((v * direction).sum())
            assert abs(difference - analytic) <= rtol * scale, (
                f"v_{name}, {place}: central difference {difference:.9g}, gradient {analytic:.9g}; they differ by "
                f"{abs(difference - analytic) / max(scale, 1e-300):.2g} of {scale:.3g}, more than {rtol:g}"
            )


def _pixel_distances(splats: AnySplats, width: int, height: int) -> Iterator[tuple[int, Array]]:
    """Yield each splat and the distances (H, W) of its pixels from a threshold, front to back, without tiles."""
    x, y = np.arange(width)[None, :] + 0.5, np.arange(height)[:, None] + 0.5
    transmittance: Array = np.ones((height, width))
    live = np.ones((height, width), dtype=bool)
    shown = np.flatnonzero(splats.extents[:, 0] > 0)
    for g in shown[np.argsort(splats.depths[shown], kind="stable")]:
        dx, dy = x - splats.means2d[g, 0], y - splats.means2d[g, 1]
        a, b, c = splats.conics[g]
        log_alpha = np.log(splats.opacities[g]) - 0.5 * (a * dx**2 + c * dy**2) - b * dx * dy
        behind = transmittance * (1 - np.minimum(np.exp(log_alpha), ALPHA_MAX))
        distance = np.minimum(np.abs(log_alpha - np.log(ALPHA_MIN)), np.abs(log_alpha - np.log(ALPHA_MAX)))
        reached = live & (log_alpha >= np.log(ALPHA_MIN))
        stop = np.where(reached, np.abs(np.log(behind / TRANSMITTANCE_MIN)), np.inf)
        yield int(g), np.where(live, np.minimum(distance, stop), np.inf)
        drawn = reached & (behind > TRANSMITTANCE_MIN)
        live &= ~reached | drawn
        transmittance = np.where(drawn, behind, transmittance)


def ambiguous_pixels(splats: AnySplats, width: int, height: int, *, margin: float = 1e-3) -> NDArray[np.bool_]:
    """Pixels in which rounding may decide whether a splat is drawn, is clamped, or is the last one.

    Parameters
    ----------
    splats : Splats of NumPy arrays
    width, height : int
        Image size, px.
    margin : float
        Relative distance below which a pixel is ambiguous: that of an alpha from ALPHA_MIN or ALPHA_MAX, or that of
        the transmittance behind a drawn splat from TRANSMITTANCE_MIN.

    Returns
    -------
    (H, W) bool
    """
    ambiguous = np.zeros((height, width), dtype=bool)
    for _, distance in _pixel_distances(splats, width, height):
        ambiguous |= distance < margin
    return ambiguous


def threshold_distances(gaussians: Gaussians, camera: Camera, *, antialiased: bool = False) -> NDArray[np.float64]:
    """Distance of each Gaussian from the nearest threshold of the rendering model.

    Parameters
    ----------
    gaussians : Gaussians
    camera : Camera
    antialiased : bool
        True if the mode "antialiased" renders them.

    Returns
    -------
    (N,) float64
        For a visible Gaussian, the smallest of: |ln(alpha/ALPHA_MIN)| and |ln(alpha/ALPHA_MAX)| over the pixels;
        |ln(T/TRANSMITTANCE_MIN)| behind the Gaussian, where it is drawn; |ln(opacity/ALPHA_MIN)|; |ln(z/NEAR)|;
        |ln(z/z')| with the next depth z'; the distance of the colour from its clamp at 0; for a pinhole, that of x/z
        and y/z from the clamp of the Jacobian; for a fisheye, that of the angle from its maximum; if antialiased,
        |ln| of the opacity's compensation over its floor. For an invisible Gaussian, only the distances of the depth,
        infinite behind the camera, and of a fisheye's angle.
    """
    g = gaussians.astype(np.float64)
    splats = project_fwd(g, camera, g.sh_degree, antialiased=antialiased)
    shown = splats.extents[:, 0] > 0
    points = g.means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    z = lens(camera, points)["depths"]
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.where(z > 0, np.abs(np.log(z / NEAR)), np.inf)
        opacity = np.abs(np.log(splats.opacities / ALPHA_MIN))
    if camera.model == "fisheye":
        angles = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
        distances = np.minimum(distances, np.abs(angles - camera.angle_max))
    near = distances.copy()
    distances = np.minimum(distances, np.where(shown, opacity, np.inf))

    offsets = (
        np.tile(camera.viewmat[2, :3], (len(g), 1)) if camera.model == "orthographic" else g.means - camera.position
    )
    basis = sh_basis(offsets / np.linalg.norm(offsets, axis=1, keepdims=True), g.sh_degree)
    colors = 0.5 + np.einsum("nk,nkc->nc", basis, g.sh)
    distances = np.minimum(distances, np.abs(colors).min(axis=1))

    if camera.model == "pinhole":
        distances = np.minimum(distances, _clamp_distances(points[:, :2] / z[:, None], camera))
    if antialiased:
        opacities = sigmoid(g.logit_opacities)
        with np.errstate(divide="ignore"):
            floor = np.log(splats.opacities / opacities / COMPENSATION_MIN)
        # At the floor the distance is 0: how far below it the ratio lies is unknown.
        distances = np.minimum(distances, np.where(shown, floor, np.inf))

    order = np.flatnonzero(shown)[np.argsort(z[shown], kind="stable")]
    gaps = np.diff(np.log(z[order]), prepend=-np.inf, append=np.inf)
    distances[order] = np.minimum(distances[order], np.minimum(gaps[:-1], gaps[1:]))
    for row, pixels in _pixel_distances(splats, camera.width, camera.height):
        distances[row] = min(distances[row], pixels.min())
    return np.where(shown, distances, near)


def _clamp_distances(slopes: Array, camera: Camera) -> Array:
    """Distance of the slopes x/z and y/z (N, 2) from the clamp of a pinhole's Jacobian, (N,)."""
    focal, size = np.array([camera.fx, camera.fy]), np.array([camera.width, camera.height])
    centre, margin = np.array([camera.cx, camera.cy]), FRUSTUM_MARGIN * 0.5 * size
    limits = np.array([-(centre + margin) / focal, (size - centre + margin) / focal])
    return np.abs(slopes[:, None] - limits).min(axis=(1, 2))


def synthetic_scene(
    n: int,
    seed: int = 0,
    *,
    width: int = 37,
    height: int = 29,
    sh_degree: int = 3,
    margin: float = 0.0,
) -> tuple[Gaussians, Camera]:
    """Random Gaussians and a camera that sees most of them.

    Parameters
    ----------
    n : int
        Number of Gaussians.
    seed : int
    width, height : int
        Image size, px. The focal length is 1.2 widths.
    sh_degree : int
        Degree of the spherical harmonics, 0 to 3.
    margin : float
        Gaussians are redrawn until `threshold_distances` is at least this in both modes. 1e-3 admits central
        differences with a step of 1e-6. 0 accepts the first draw.

    Returns
    -------
    gaussians : Gaussians, float64
        Within 1.5 of the origin, 1 to 6 px in size, with opacities of 0.12 to 0.95.
    camera : Camera
        At a distance of 4 from the origin.

    Raises
    ------
    InputError
        If the margin cannot be kept, because the margin or n is too large for the image.
    """
    rng = np.random.default_rng(seed)
    camera = Camera.look_at((1.5, -1.0, 3.57), (0, 0, 0), (0, 1, 0), 1.2 * width, width, height)

    gaussians = _draw(rng, n, height / width, sh_degree)
    if margin <= 0:
        return gaussians, camera
    for _ in range(DRAWS_MAX):
        near = np.zeros(n, dtype=bool)
        for antialiased in (False, True):
            near |= threshold_distances(gaussians, camera, antialiased=antialiased) < margin
        if not near.any():
            return gaussians, camera
        fresh = _draw(rng, int(near.sum()), height / width, sh_degree).arrays()
        for name, array in gaussians.arrays().items():
            array[near] = fresh[name]
    raise InputError(
        f"margin: expected one that {n} random Gaussians can keep at {width}x{height} px, found {margin}; "
        "use fewer Gaussians or a smaller margin"
    )


def _draw(rng: np.random.Generator, n: int, aspect: float, sh_degree: int) -> Gaussians:
    """Random Gaussians of `synthetic_scene`. `aspect` is the image's height over its width."""
    sh = rng.normal(0, 0.15, (n, (sh_degree + 1) ** 2, 3))
    sh[:, 0] = rng.normal(0.3, 0.6, (n, 3))
    return Gaussians(
        means=rng.uniform(-1.5, 1.5, (n, 3)) * [1, aspect, 1],
        log_scales=rng.uniform(np.log(0.03), np.log(0.4), (n, 3)),
        quats=rng.normal(size=(n, 4)),
        logit_opacities=rng.uniform(-2, 3, n),
        sh=sh,
    )
