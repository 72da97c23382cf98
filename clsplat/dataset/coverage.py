"""Held-out pixels that show what few training photos show, from the sparse points and the cameras alone."""

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.reference.lens import lens
from clsplat.scene import Scene

COLUMNS = 64
"""Approximate number of blocks across a photo; the pixels of a block share one depth. The sparse points of a photo,
some thousands, determine no finer depths."""

NEIGHBOURS = 8
"""Number of projected points nearest to a block from which its depth is taken."""

QUANTILE = 0.25
"""Quantile of the neighbours' depths that counts as the depth of the block. It is low because points behind a surface
are projected between those on it, but not the lowest because of outliers."""

VIEWS_MIN = 3
"""Number of training photos below which a pixel is rare. A point that only two photos show can lie at a wrong depth
without an error in either of them, if its colour changes with the direction; a third photo contradicts it."""


def rare_pixels(scene: Scene, points: NDArray[np.float64]) -> list[NDArray[np.bool_]] | None:
    """Find the held-out pixels that show what fewer than `VIEWS_MIN` training photos contain.

    They do not depend on a trained model. Surfaces in between are not considered: a pixel that is not rare may show
    what all training photos but two see only from behind.

    Parameters
    ----------
    scene : Scene
        With held-out photos.
    points : (P, 3) float64
        Sparse points from which depths are taken. They may be more than those of the scene.

    Returns
    -------
    list of (H, W) bool, or None
        One array per held-out photo, True at rare pixels. None if a photo shows fewer than `NEIGHBOURS` points.
    """
    masks = []
    for view in scene.test:
        width, height = view.camera.width, view.camera.height
        block = max(1, width // COLUMNS)
        u, v = np.meshgrid(_centres(width, block), _centres(height, block))
        shown = _unprojected(view.camera, np.stack([u.ravel(), v.ravel()], axis=1), points)
        if shown is None:
            return None
        # Outside the image circle of a fisheye, a pixel shows nothing.
        left = np.flatnonzero(np.isfinite(shown).all(axis=1))
        count = np.zeros(len(shown), dtype=int)
        for other in scene.train:
            count[left] += projected(other.camera, shown[left])[2]
            left = left[count[left] < VIEWS_MIN]
        blocks = np.zeros(u.shape, dtype=bool)
        blocks.flat[left] = True
        masks.append(np.repeat(np.repeat(blocks, block, axis=0), block, axis=1)[:height, :width])
    return masks


def _centres(size: int, block: int) -> NDArray[np.float64]:
    """Centres of the blocks along an edge, px. The last block may extend beyond the image; its centre does not."""
    return np.minimum((np.arange(-(-size // block)) + 0.5) * block, size - 0.5)


def _unprojected(
    camera: Camera, pixels: NDArray[np.float64], points: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Points in the world that pixels (N, 2) show; None if too few sparse points are in the image."""
    from scipy.spatial import cKDTree

    places, depths, inside = projected(camera, points)
    if inside.sum() < NEIGHBOURS:
        return None
    _, nearest = cKDTree(places[inside]).query(pixels, NEIGHBOURS)
    depth = np.quantile(depths[inside][nearest], QUANTILE, axis=1)
    rays = camera.rays(*pixels.T)
    # The depth of a point is its distance where a camera may see behind itself, and otherwise its z.
    along = rays if camera.model in ("fisheye", "equirectangular") else rays / rays[:, 2:]
    return (along * depth[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def projected(
    camera: Camera, points: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.bool_]]:
    """Places in the image (N, 2), depths (N,), and whether the points (N, 3) of the world are in the image."""
    with np.errstate(divide="ignore", invalid="ignore"):  # a point in the plane of the camera has no place
        found = lens(camera, points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3], derivatives=False)
        places = found["means2d"]
        inside = found["seen"] & ((places >= 0) & (places < [camera.width, camera.height])).all(axis=1)
    return places, found["depths"], inside
