"""Surfaces of a trained still life against its true ones: depths, normals and meshes.

``python tests/training/measure_surfaces.py`` prints the figures of docs/howto/mesh.md: errors of depths and normals
in three held-out photos, and distances between meshes and the true surface.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsplat import Camera, Device, Gaussians, TrainConfig, render, train
from clsplat.demo.known_photos import known_scene
from clsplat.demo.ray_tracer import camera_rays, trace
from clsplat.demo.still_life import still_life
from clsplat.meshing import make_mesh
from clsplat.renderer import Renderer
from clsplat.scene import Scene
from clsplat.show.frames import normals

Array = NDArray[np.float64]

STEP = 1e-3
"""Distance of the rays whose differences make the true normals, px."""

BOX = np.array([[-1.2, -1.2, -0.1], [1.2, 1.2, 1.3]])
"""The part of the scene on the table, m."""

FINE = 3
"""Rays along the edge of a pixel that sample the true surface: a point every 5 mm."""

RESOLUTIONS = (128, 256)
"""Voxels along the longest edge of the box."""


def true_points(camera: Camera, x: Array, y: Array) -> Array:
    """Points (N, 3) of the still life on the rays through image points; not finite where a ray meets nothing."""
    rays = camera_rays(camera, x.ravel(), y.ravel())
    origins = np.repeat(camera.position[:, None], rays.shape[1], axis=1)
    return np.asarray((origins + trace(origins, rays, still_life())[0] * rays).T)


def grid(camera: Camera, per_pixel: int = 1) -> tuple[Array, Array]:
    """Image points (H, W) in the centres of pixels, or of equal parts of them."""
    y, x = np.indices((camera.height * per_pixel, camera.width * per_pixel))
    return (x + 0.5) / per_pixel, (y + 0.5) / per_pixel


def true_normals(camera: Camera) -> Array:
    """Normals (H, W, 3) of the still life in world coordinates; not finite where a ray meets nothing."""
    x, y = grid(camera)
    shifts = ((0.0, 0.0), (STEP, 0.0), (0.0, STEP))
    points = [true_points(camera, x + right, y + down).reshape(*x.shape, 3) for right, down in shifts]
    across = np.cross(points[2] - points[0], points[1] - points[0])
    return to_camera(across / np.linalg.norm(across, axis=2, keepdims=True), points[0] - camera.position)


def to_camera(vectors: Array, rays: Array) -> Array:
    """Turn vectors against the rays."""
    return np.where((vectors * rays).sum(axis=2, keepdims=True) > 0, -vectors, vectors)


def summary(errors: Array) -> str:
    return f"median {np.median(errors):.1f}, mean {errors.mean():.1f}"


def images(trained: Gaussians, scene: Scene, device: Device) -> Iterator[str]:
    """Sentences on the depths and the normals in the held-out photos."""
    for view in scene.test:
        camera = view.camera
        rendering = render(trained, camera, device=device, depth=True)
        surface, true = rendering.surface(), true_normals(camera)
        assert rendering.depth is not None
        of_depth = normals(rendering.depth, camera) @ camera.viewmat[:3, :3]
        x, y = grid(camera)
        away = (true_points(camera, x, y) @ camera.viewmat[2, :3] + camera.viewmat[2, 3]).reshape(x.shape)
        seen = np.isfinite(true).all(axis=2) & (rendering.alpha > 0.5) & (surface.ids >= 0)
        for name, depth, found in (
            ("median Gaussians", surface.depth, surface.normals),
            ("expected depth", rendering.depth, of_depth),
        ):
            errors = 100 * np.abs(depth / away - 1)[seen]
            angles = np.degrees(np.arccos(np.clip((found * true).sum(axis=2)[seen], -1, 1)))
            yield f"{view.name}, {name}: depths {summary(errors)} %, normals {summary(angles)} degrees"


def meshes(trained: Gaussians, scene: Scene, device: Device) -> Iterator[str]:
    """Sentences on the distances between meshes and the true surface."""
    cameras = [view.camera for view in scene.train]
    true = np.concatenate([true_points(camera, *grid(camera, FINE)) for camera in cameras])
    true = true[((true > BOX[0]) & (true < BOX[1])).all(axis=1)]
    tree = cKDTree(true)
    for resolution in RESOLUTIONS:
        mesh = make_mesh(trained, cameras, Renderer(device), resolution=resolution, box=(BOX[0], BOX[1]))
        accuracy = 1000 * tree.query(mesh.vertices)[0]
        completeness = 1000 * cKDTree(mesh.vertices).query(true)[0]
        yield (
            f"{resolution} voxels, {len(mesh.faces)} triangles: accuracy {summary(accuracy)} mm, "
            f"completeness {summary(completeness)} mm"
        )


def main() -> None:
    """Train, measure, and print."""
    scene, device = known_scene(24, 160, 120, 4000), Device()
    with TemporaryDirectory() as folder:
        trained = train(scene, TrainConfig(iterations=1500, max_gaussians=15000), Path(folder) / "run", device)
    for measure in (images, meshes):
        for sentence in measure(trained, scene, device):
            print(sentence, flush=True)


if __name__ == "__main__":
    main()
