"""A mesh from the surfaces that cameras see: fusion of depths to a distance field, and marching cubes."""

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.render import renderings
from clsplat.renderer import Renderer
from clsplat.surface import scene_depth

Array = NDArray[np.float64]

TRUNCATION = 4.0
"""Distance from a surface, in voxels, up to which it counts. Noise of the depths of about a voxel is then averaged,
and thin objects keep two sides (Curless and Levoy 1996, section 3)."""

QUANTILE = 0.02
"""Fraction of the surface points that may lie outside the box on each side."""

SLAB = 16
"""Layers of voxels that are projected at once."""

STEP = 1e-5
"""Largest step of coordinates in a file, over the size of the mesh: a hundredth of one of 1000 voxels."""

NO_SURFACE = "mesh: expected surfaces in the box, found none; see box and resolution"
"""Message where no triangle can be made."""


class Mesh(NamedTuple):
    """A triangle mesh: vertices (V, 3) in world units, faces (F, 3) int, and colors (V, 3) uint8, RGB."""

    vertices: Array
    faces: NDArray[np.int64]
    colors: NDArray[np.uint8]


class _View(NamedTuple):
    """A camera with its image (H, W, 3) and its depths (H, W): seven bytes per pixel. A depth is 0 where less than
    half of the light is stopped, and NaN where half of it is, but at no depth."""

    camera: Camera
    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]


def make_mesh(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    renderer: Renderer,
    *,
    resolution: int = 256,
    box: tuple[ArrayLike, ArrayLike] | None = None,
) -> Mesh:
    """Make a mesh of the surfaces that cameras see.

    The median depth of each image is fused to a truncated signed distance field (Curless and Levoy 1996), whose zeros
    are the mesh (marching cubes of scikit-image).

    Parameters
    ----------
    gaussians : Gaussians
    cameras : iterable of Camera
        Pinholes; each is rendered once.
    renderer : Renderer
    resolution : int
        Voxels along the longest edge of the box.
    box : pair of (3,), optional
        Smallest and largest coordinates of the mesh, world units. Default: the box of all surface points, except for
        the outermost fiftieth on each side.

    Returns
    -------
    Mesh
        Vertices in world units, faces and colours.

    Raises
    ------
    InputError
        If a camera is not a pinhole, or no surface is seen.
    """
    views = []
    for camera in cameras:
        if camera.model != "pinhole":
            raise InputError(f"mesh: expected pinhole cameras, found one of model {camera.model}")
        rendering = next(renderings(renderer, gaussians, [camera], gradients=True))
        depth = rendering.surface().depth.astype(np.float32)
        depth[(depth == 0) & (rendering.alpha >= 0.5)] = np.nan
        views.append(_View(camera, to_uint8(rendering.rgb), depth))
    low, high = box if box is not None else _box(views)
    corner, size = np.asarray(low, np.float64), np.asarray(high, np.float64) - np.asarray(low, np.float64)
    voxel = float(size.max()) / resolution
    if not (size > 0).all():
        raise InputError(f"box: expected a box with a positive size, found {low} to {high}")
    shape = tuple(int(n) for n in np.maximum(np.ceil(size / voxel), 1) + 1)
    return _zeros(*_fused(views, corner, voxel, (shape[0], shape[1], shape[2])), corner, voxel)


def _box(views: list[_View]) -> tuple[Array, Array]:
    """The box of the surface points that the views see, without the sky and a fiftieth on each side, and a margin."""
    points = []
    limit = scene_depth(np.concatenate([depth[depth > 0] for _, _, depth in views])) if views else 0.0
    for camera, _, depth in views:
        v, u = np.nonzero((depth > 0) & (depth <= limit))
        z = depth[v, u][:, None]
        at = np.stack([(u + 0.5 - camera.cx) / camera.fx, (v + 0.5 - camera.cy) / camera.fy, np.ones(len(u))], axis=1)
        points.append((at * z - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3])
    found = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(found):
        raise InputError("mesh: expected a surface, found no pixel in which the Gaussians stop half of the light")
    low, high = np.quantile(found, [QUANTILE, 1 - QUANTILE], axis=0)
    margin = 0.05 * (high - low).max()
    return low - margin, high + margin


def _fused(
    views: list[_View], corner: Array, voxel: float, shape: tuple[int, int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_]]:
    """Mean signed distances, in voxels, positive in front of surfaces (NaN: nothing is seen); mean colours; and which
    voxels have a colour, those near a surface."""
    distances = np.full(shape, np.nan, np.float32)
    colors, has_color = np.zeros((*shape, 3), np.float32), np.zeros(shape, bool)
    y, z = (corner[k] + voxel * np.arange(shape[k]) for k in (1, 2))
    for first in range(0, shape[0], SLAB):
        x = corner[0] + voxel * np.arange(first, min(first + SLAB, shape[0]))
        points = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
        total, weights = np.zeros(len(points)), np.zeros(len(points))
        color, coloured = np.zeros((len(points), 3)), np.zeros(len(points))
        for camera, rgb, depth in views:
            p = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
            front = p[:, 2] > 0  # also before the near plane, all of the ray is free
            with np.errstate(divide="ignore", invalid="ignore"):
                u = np.floor(camera.fx * p[:, 0] / p[:, 2] + camera.cx)
                v = np.floor(camera.fy * p[:, 1] / p[:, 2] + camera.cy)
            front &= (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
            which = np.flatnonzero(front)
            columns, rows = u[which].astype(int), v[which].astype(int)
            surface = depth[rows, columns]
            # A pixel without a surface shows that all of its ray is free. Behind a surface, nothing is known, and NaN
            # counts nowhere.
            ahead = (np.where(surface == 0, np.inf, surface) - p[which, 2]) / voxel
            counts = ahead > -TRUNCATION
            which, ahead = which[counts], np.minimum(ahead[counts], TRUNCATION)
            total[which] += ahead
            weights[which] += 1
            shown = np.abs(ahead) < TRUNCATION
            color[which] += rgb[rows[counts], columns[counts]] * shown[:, None]
            coloured[which] += shown
        near = slice(first, first + len(x))
        with np.errstate(invalid="ignore"):
            distances[near] = (total / weights).reshape(-1, *shape[1:])
        colors[near] = (color / np.maximum(coloured, 1)[:, None]).reshape(-1, *shape[1:], 3)
        has_color[near] = (coloured > 0).reshape(-1, *shape[1:])
    return distances, colors, has_color


def _zeros(
    distances: NDArray[np.float32],
    colors: NDArray[np.float32],
    has_color: NDArray[np.bool_],
    corner: Array,
    voxel: float,
) -> Mesh:
    """The mesh where the distances change their sign, between voxels that cameras see."""
    from scipy.ndimage import binary_erosion, map_coordinates
    from skimage.measure import marching_cubes

    known = np.isfinite(distances)
    # No triangle lies between what is seen and what is not.
    inside = binary_erosion(known, np.ones((3, 3, 3)), border_value=1)
    if not ((distances[inside] > 0).any() and (distances[inside] < 0).any()):
        raise InputError(NO_SURFACE)
    try:
        vertices, faces, _, _ = marching_cubes(np.where(known, distances, np.float32(TRUNCATION)), 0.0, mask=inside)
    except RuntimeError as error:  # voxels in front of surfaces and behind them do not touch
        raise InputError(NO_SURFACE) from error
    # Voxels without a colour have no part in the mean. Those behind a surface have one, so that the weight is not 0.
    layers = (colors[..., 0], colors[..., 1], colors[..., 2], has_color)
    *at, weight = (map_coordinates(layer, vertices.T, np.float32, 1, "nearest") for layer in layers)
    rgb = np.rint(np.clip(np.stack(at, axis=1) / weight[:, None], 0, 255)).astype(np.uint8)
    return Mesh(corner + voxel * vertices.astype(np.float64), faces.astype(np.int64), rgb)


def save_mesh(path: Path | str, mesh: Mesh) -> None:
    """Write a mesh as a binary PLY file with colours, which MeshLab, Blender and others read.

    Coordinates have double precision where single precision would blur the mesh: far from the origin.
    """
    from plyfile import PlyData, PlyElement

    names = ("x", "y", "z", "red", "green", "blue")
    steps = np.spacing(np.abs(mesh.vertices).max(axis=0).astype(np.float32))
    real = "f8" if (steps > STEP * np.ptp(mesh.vertices, axis=0).max()).any() else "f4"
    vertices = np.empty(len(mesh.vertices), [(name, real if name in "xyz" else "u1") for name in names])
    for name, column in zip(names, (*mesh.vertices.T, *mesh.colors.T), strict=True):
        vertices[name] = column
    faces = np.empty(len(mesh.faces), [("vertex_indices", "i4", (3,))])
    faces["vertex_indices"] = mesh.faces
    with replacing(Path(path)) as file:
        PlyData([PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]).write(file)
