"""Depth maps of photos: find and read their files, and scale them to the sparse points that the photos see.

Depths that a network estimates from one photo have an unknown scale and shift, and often are inverse depths; those of
a sensor have another unit than the scene. Two numbers per photo make them comparable (Ranftl et al. 2020, "Towards
robust monocular depth estimation"; Kerbl et al. 2024, "A hierarchical 3D Gaussian representation").
"""

import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.dataset.coverage import projected
from clsplat.dataset.decoding import Dataset, PosedPhoto, fits, nearest, plan_view
from clsplat.dataset.finding import without_suffix
from clsplat.dataset.lenses import Intrinsics, is_pinhole
from clsplat.dataset.photos import loaded, opened
from clsplat.dataset.undistortion import lens_positions, resampled
from clsplat.errors import InputError
from clsplat.scene import DepthMap, Scene, View

SUFFIXES = (".png", ".npy", ".tiff", ".tif")
"""Suffixes of depth maps, in the order in which they are searched."""

GREY = ("I", "I;16", "I;16B", "F")
"""Pillow modes of one channel with 16 bits or floats."""

POINTS_MIN = 10
"""Fewest points from which the scale and the shift of a map are fitted: five for each number."""

CELLS = 24
"""Approximate number of cells across a photo in which the nearest point hides those behind it. The sparse points of a
photo, some thousands, are several in each."""

SURFACE = 0.1
"""Depth behind the nearest point of a cell up to which points belong to the same surface, as a fraction. Other points
are hidden, and the map does not show them."""

AGREEMENT = 0.7
"""Largest median error of a fitted map at the points, as a fraction of that of a constant depth. A map that has
nothing to do with its photo does no better than a constant: 1."""

PAIRED = 1000
"""Approximate number of points of which all pairs are compared; the others are skipped."""

BIWEIGHT = 1.4826 * 4.685
"""Error, in median absolute errors, from which Tukey's biweights are 0: with normal errors, they have 95 % of the
efficiency of least squares (Holland and Welsch 1977)."""

ROUNDS = 20
"""Rounds of reweighting in a fit."""

Array = NDArray[np.float64]


def find_depth_map(folder: Path, name: str) -> Path:
    """Locate the depth map of the photo `name` in `folder`: for ``a.jpg``, ``a.png`` or ``a.jpg.png``, or the same
    with another one of `SUFFIXES`.

    Raises
    ------
    InputError
        If the photo has no depth map.
    """
    inside = name if (folder / "images").is_dir() else name.removeprefix("images/")
    candidates = [folder / f"{stem}{s}" for s in SUFFIXES for stem in (without_suffix(inside), inside)]
    for file in candidates:
        if file.is_file():
            return file
    raise InputError(
        f"cannot find the depth map of photo {name}: neither {candidates[0]} nor the same with one of "
        f"{', '.join(SUFFIXES[1:])} exists"
    )


def read_depth_map(path: Path, upright: bool = False) -> NDArray[np.float32]:
    """Read a depth map: (H, W) float32, NaN where the file has 0, NaN or infinity; `upright` as for its photo.

    Raises
    ------
    InputError
        If the file cannot be read, has several channels or 8 bits, or knows no depth; the message names it.
    """
    values = _read_array(path) if path.suffix == ".npy" else _read_picture(path, upright)
    known = np.isfinite(values) & (values != 0)
    if not known.any():
        raise InputError(f"{path}: expected depths, found only 0 or numbers that are not finite, which mean unknown")
    return np.where(known, values, np.float32(np.nan))


def _read_array(path: Path) -> NDArray[np.float32]:
    try:
        values = np.lib.format.open_memmap(path, mode="r")  # mapped: a damaged header allocates nothing
    except (EOFError, OSError, SyntaxError, ValueError) as error:
        raise InputError(f"cannot read {path} as an array of NumPy: {error}") from error
    if values.ndim != 2 or not values.size or values.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: expected numbers of shape (height, width), found {values.dtype} of shape {values.shape}"
        )
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, which means unknown
        return values.astype(np.float32)


def _read_picture(path: Path, upright: bool) -> NDArray[np.float32]:
    with opened(path) as image:
        if image.mode not in GREY:
            raise InputError(
                f"{path}: expected one channel of 16 bits or floats, found mode {image.mode}; 8 bits are too coarse "
                "for depths: write a 16-bit PNG, a TIFF with floats, or .npy"
            )
        return np.asarray(loaded(image, upright)).astype(np.float32)


def load_depth_map(path: Path, photo: PosedPhoto, dataset: Dataset) -> DepthMap:
    """Read the depth map of a photo, and undistort and reduce it as the photo, by nearest neighbour.

    Raises
    ------
    InputError
        If the file cannot be read, or its shape differs from the photo's; the message names it.
    """
    plan, reduce = plan_view(photo, dataset, invert_mask=False), dataset.reduce
    values = read_depth_map(path, plan.upright)
    width, height = plan.size
    if not fits((values.shape[1], values.shape[0]), Intrinsics("PINHOLE", (), width, height)):
        raise InputError(
            f"{path}: expected a depth map with the aspect ratio of the photo, {width}x{height} pixels, found "
            f"{values.shape[1]}x{values.shape[0]}"
        )
    values, camera = nearest(values, height, width), plan.camera
    if camera.model == "pinhole" and not is_pinhole(photo.intrinsics):
        positions = lens_positions(photo.intrinsics, plan.size, (camera.height * reduce, camera.width * reduce))
        values = resampled(values, positions, 0)
    return DepthMap(nearest(values[: camera.height * reduce, : camera.width * reduce], camera.height, camera.width))


class _Samples(NamedTuple):
    """Values of a map where a photo shows points, and the depths of these points, world units; both (n,)."""

    values: Array
    depths: Array


def _samples(view: View, points: Array) -> _Samples:
    """Pairs of a map's value and a point's depth, without points behind others."""
    assert view.depth
    places, depths, inside = projected(view.camera, points)
    columns, rows = places[inside].astype(int).T
    values, depths = view.depth.values[rows, columns].astype(np.float64), depths[inside]
    edge = max(1, view.camera.width // CELLS)
    cells = rows // edge * view.camera.width + columns // edge
    nearest_depth = np.full(view.camera.width * view.camera.height, np.inf)
    np.minimum.at(nearest_depth, cells, depths)
    used = (depths <= (1 + SURFACE) * nearest_depth[cells]) & np.isfinite(values)
    return _Samples(values[used], depths[used])


def _rank_correlation(samples: _Samples) -> float:
    """Spearman's correlation of values and depths; 0 where it is not defined."""
    from scipy.stats import spearmanr

    if len(samples.values) < POINTS_MIN or not np.ptp(samples.values) or not np.ptp(samples.depths):
        return 0.0
    return float(spearmanr(samples.values, samples.depths).statistic)


def _fitted(samples: _Samples, inverse: bool) -> tuple[float, float, float, float]:
    """Scale and shift that fit the map's inverse depths to those of the points, even if some of them are wrong.

    The median of the slopes between pairs (Theil 1950, Sen 1968) is the start, since neither wrong depths of the map
    nor points that are wrong or hidden change it much. Reweighted least squares with Tukey's biweights,
    which are 0 far off, make it exact.

    Returns
    -------
    scale, shift : float
    error : float
        Median error, as a fraction of the depth.
    ratio : float
        Median error of the inverse depths, as a fraction of that of their median.
    """
    from scipy.stats import theilslopes

    values, depths = samples
    # An error e of the depth z is one of e/z^2 of the inverse depth.
    target, weights = (1 / depths, np.ones_like(depths)) if inverse else (depths, depths**-2.0)
    chosen = slice(None, None, -(-len(values) // PAIRED))
    scale, shift = theilslopes(target[chosen], values[chosen])[:2]
    terms = np.stack([values, np.ones_like(values)], axis=1)
    size = np.abs(terms).max(axis=0)
    for _ in range(ROUNDS):
        off = weights * np.abs(scale * values + shift - target)
        most = BIWEIGHT * np.median(off) + 1e-12 * np.median(1 / depths)
        root = weights * np.maximum(1 - (off / most) ** 2, 0)
        found = np.linalg.lstsq(terms / size * root[:, None], target * root, rcond=None)[0] / size
        scale, shift = float(found[0]), float(found[1])
    off = weights * np.abs(scale * values + shift - target)
    constant = weights * np.abs(np.median(target) - target)
    ratio = float(np.median(off) / max(np.median(constant), 1e-300))
    return scale, shift, float(np.median(off * depths)), ratio


def aligned(scene: Scene, tell: Callable[[str], None] = lambda text: None) -> Scene:
    """Scale the depth maps of the training photos to the scene's points, despite some that are wrong.

    Whether the maps hold depths or inverse depths follows from the sign of their correlation with the points' depths,
    over all photos.

    Parameters
    ----------
    scene : Scene
        With points, and depth maps as they were read.
    tell : callable
        Called with a sentence about the result.

    Returns
    -------
    Scene
        The maps with their scales and shifts; without those that do not agree with the points.

    Raises
    ------
    InputError
        If there are no points, or no map agrees with them.

    Warns
    -----
    UserWarning
        If some maps do not agree with the points, or show too few of them.
    """
    if not len(scene.points):
        raise InputError(
            "--depth: expected a scene with points, to which depth maps are scaled, found none; leave out --depth, "
            "or --init.no-triangulate where it was given"
        )
    samples = {view.name: _samples(view, scene.points) for view in scene.train if view.depth}
    inverse = sum(len(s.values) * _rank_correlation(s) for s in samples.values()) < 0
    maps: dict[str, DepthMap | None] = {}
    errors = []
    for view in scene.train:
        if view.depth is None:
            continue
        maps[view.name], found = None, samples[view.name]
        if len(found.values) < POINTS_MIN or not np.ptp(found.values):
            continue
        scale, shift, error, ratio = _fitted(found, inverse)
        if scale > 0 and ratio <= AGREEMENT:
            maps[view.name] = replace(view.depth, inverse=inverse, scale=scale, shift=shift)
            errors.append(error)
    unlike = [name for name, depth in maps.items() if depth is None]
    if not errors:
        raise InputError(
            "--depth: expected depth maps that agree with the scene's points, found none; each must show the photo "
            f"of its name, as depths or inverse depths, and at least {POINTS_MIN} points"
        )
    if unlike:
        warnings.warn(
            f"--depth: {len(unlike)} of {len(maps)} depth maps do not agree with the points, or show fewer than "
            f"{POINTS_MIN}, and are not used (first: {unlike[0]})",
            stacklevel=2,
        )
    kind = "inverse depths" if inverse else "depths"
    tell(
        f"depth maps: {len(errors)} of {kind}; once scaled, they differ from the points by {np.median(errors):.1%} "
        "of the depth (median)"
    )
    return replace(scene, train=[view.with_depth(maps.get(view.name)) for view in scene.train])
