"""Normals of a trained still life against its true ones: of the median Gaussians, and of the expected depth.

``python tests/training/measure_normals.py`` prints the angles between them in the three held-out photos of
docs/howto/mesh.md.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from clsplat import Camera, Device, TrainConfig, render, train
from clsplat.demo.known_photos import known_scene
from clsplat.demo.ray_tracer import camera_rays, trace
from clsplat.demo.still_life import still_life
from clsplat.show.frames import normals

STEP = 1e-3
"""Distance of the rays whose differences make the true normals, px."""


def true_normals(camera: Camera) -> NDArray[np.float64]:
    """Normals (H, W, 3) of the still life in world coordinates; not finite where a ray meets nothing."""
    solids = still_life()
    y, x = np.meshgrid(np.arange(camera.height) + 0.5, np.arange(camera.width) + 0.5, indexing="ij")
    points = []
    for right, down in ((0.0, 0.0), (STEP, 0.0), (0.0, STEP)):
        rays = camera_rays(camera, x.ravel() + right, y.ravel() + down)
        origins = np.repeat(camera.position[:, None], rays.shape[1], axis=1)
        points.append((origins + trace(origins, rays, solids)[0] * rays).T.reshape(*x.shape, 3))
    across = np.cross(points[2] - points[0], points[1] - points[0])
    return to_camera(across / np.linalg.norm(across, axis=2, keepdims=True), points[0] - camera.position)


def to_camera(vectors: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn vectors against the rays."""
    return np.where((vectors * rays).sum(axis=2, keepdims=True) > 0, -vectors, vectors)


def main() -> None:
    """Train, measure, and print."""
    scene, device = known_scene(24, 160, 120, 4000), Device()
    with TemporaryDirectory() as folder:
        trained = train(scene, TrainConfig(iterations=1500, max_gaussians=15000), Path(folder) / "run", device)
    for view in scene.test:
        camera = view.camera
        rendering = render(trained, camera, device=device, depth=True)
        surface, true = rendering.surface(), true_normals(camera)
        assert rendering.depth is not None
        of_depth = normals(rendering.depth, camera) @ camera.viewmat[:3, :3]
        seen = np.isfinite(true).all(axis=2) & (rendering.alpha > 0.5) & (surface.ids >= 0)
        for name, found in (("median Gaussians", surface.normals), ("expected depth", of_depth)):
            angles = np.degrees(np.arccos(np.clip((found * true).sum(axis=2)[seen], -1, 1)))
            print(f"{view.name}, {name}: median {np.median(angles):.1f}, mean {angles.mean():.1f} degrees")


if __name__ == "__main__":
    main()
