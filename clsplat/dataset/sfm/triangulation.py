"""Points for datasets that bring poses alone, triangulated from their photos by COLMAP through pycolmap.

Features and matches are those of `clsplat.dataset.sfm.matching`; the poses are taken as they are (Schoenberger and
Frahm 2016, section 4.2, doi:10.1109/CVPR.2016.445).
"""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.camera import Camera
from clsplat.dataset.sfm.matching import SEED, extract, is_sliver, match, quiet
from clsplat.errors import InputError
from clsplat.randomness import stream
from clsplat.scene import View

NEIGHBOURS = 10
"""Photos that each is matched with: as many as COLMAP's sequential matching takes before each frame of a video."""

ANGLE_MAX = np.pi / 3
"""Between the axes of two photos that are matched. SIFT finds points again up to about half of that, and what two
photos see beside their axes differs less than these."""

EDGE_MAX = 1000
"""Longer edge, in pixels, at which features are sought. With fox_pinhole's photos of 960 pixels training reaches what
COLMAP's own points give (32.1 dB at 134x240 after 2000 iterations), with 480 pixels 0.7 dB less; the time for matches
grows with the fourth power."""

FEWEST = 100
"""Points that are taken for a scene; fewer say next to nothing of where it is."""

START = 20_000
"""Points that fewer are filled up to. fern's 4564 give 28.9 dB (240x180, 2000 iterations), filled up to 10 000 they
give 29.2, up to 20 000 29.3; lego's 5579 give 32.0 and filled up 32.7 dB, where a random start gives 30.3."""

FILLING = 8
"""Nearest points of each, towards which others are put."""


def pairs(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Photos worth matching: each with the nearest that look the same way from another place.

    Parameters
    ----------
    cameras : list of Camera

    Returns
    -------
    list of (int, int)
        Indices, the smaller one first, sorted.
    """
    positions = np.array([camera.position for camera in cameras]).reshape(-1, 3)
    axes = np.array([camera.viewmat[2, :3] for camera in cameras]).reshape(-1, 3)
    found = set()
    for i, (position, axis) in enumerate(zip(positions, axes, strict=True)):
        distances = np.linalg.norm(positions - position, axis=1)
        # Faces of a panorama stand at one place but for rounding: nothing can be triangulated from them.
        apart = distances > 1e-9 * np.abs(positions).max()
        distances = np.where(apart & (axes @ axis > np.cos(ANGLE_MAX)), distances, np.inf)
        nearest = np.argsort(distances, kind="stable")[:NEIGHBOURS]
        found |= {(min(i, j), max(i, j)) for j in nearest.tolist() if np.isfinite(distances[j])}
    return sorted(found)


def triangulate(views: Iterable[View], verbose: bool = False) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Points that several photos with known poses see.

    Parameters
    ----------
    views : iterable of View
        With pinhole or fisheye cameras. They are drawn one after another and not kept: photos may be large.
    verbose : bool
        Show COLMAP's own messages.

    Returns
    -------
    points : (P, 3) float64
        In world units; P is 0 where fewer than `FEWEST` were found.
    colors : (P, 3) uint8
        Means of the photos'.

    Raises
    ------
    InputError
        If a camera is neither.
    """
    import pycolmap

    with TemporaryDirectory(prefix="clsplat_triangulate_") as folder, quiet(verbose):
        work = Path(folder)
        database = work / "database.db"
        cameras = _database(views, database, work)
        chosen = pairs(list(cameras.values()))
        if not chosen:
            return np.zeros((0, 3)), np.zeros((0, 3), np.uint8)
        names = list(cameras)
        extract(database, work, names, EDGE_MAX, work / "masks")
        with pycolmap.Database.open(database) as opened:
            numbers = {row.name: row.image_id for row in opened.read_all_images()}
        match(database, [(numbers[names[i]], numbers[names[j]]) for i, j in chosen], verbose)
        model = pycolmap.Reconstruction()
        with pycolmap.Database.open(database) as opened:
            for camera in opened.read_all_cameras():
                model.add_camera_with_trivial_rig(camera)
            for row in opened.read_all_images():
                image = pycolmap.Image(name=row.name, camera_id=row.camera_id, image_id=row.image_id)
                model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cameras[row.name].viewmat[:3]))
        options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, num_threads=1)
        (work / "model").mkdir()
        model = pycolmap.triangulate_points(model, database, work, work / "model", options=options)
    points = [point for _, point in sorted(model.points3D.items())]
    kept = points if len(points) >= FEWEST else []
    return (
        np.array([point.xyz for point in kept]).reshape(-1, 3),
        np.array([point.color for point in kept], np.uint8).reshape(-1, 3),
    )


def filled(points: NDArray[np.float64], colors: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """More points, on the lines between neighbours: features leave gaps where the photos show little texture.

    Parameters
    ----------
    points : (P, 3) float64
        More than `FILLING`.
    colors : (P, 3) uint8

    Returns
    -------
    points, colors
        `START` of them, the given ones first; these alone where they are not fewer.
    """
    from scipy.spatial import cKDTree

    missing = START - len(points)
    if missing <= 0:
        return points, colors
    rng = stream(SEED, "points between points")
    _, neighbours = cKDTree(points).query(points, k=FILLING + 1)
    rows = rng.integers(0, len(points), missing)
    others = neighbours[rows, rng.integers(1, FILLING + 1, missing)]  # the first is the point itself
    share = rng.uniform(size=(missing, 1))
    between = points[rows] + share * (points[others] - points[rows])
    blended = np.rint(colors[rows] + share * (colors[others].astype(float) - colors[rows])).astype(np.uint8)
    return np.concatenate([points, between]), np.concatenate([colors, blended])


def _database(views: Iterable[View], database: Path, work: Path) -> dict[str, Camera]:
    """Photos and masks as files that COLMAP reads, their cameras in its database; cameras by the files' names."""
    import pycolmap

    pycolmap.Database.open(database).close()
    cameras: dict[str, Camera] = {}
    (work / "masks").mkdir()
    for number, view in enumerate(views):
        name, camera = f"{number:06}.png", view.camera
        if camera.model not in ("pinhole", "fisheye"):
            raise InputError(f"{view.name}: expected a pinhole or fisheye camera, found {camera.model}")
        if is_sliver(camera.width, camera.height, EDGE_MAX):
            continue
        # Read once, then deleted: speed before size.
        Image.fromarray(view.image).save(work / name, compress_level=1)
        counts = np.ones(view.image.shape[:2], bool) if view.mask is None else view.mask
        Image.fromarray(counts).save(work / "masks" / f"{name}.png")  # COLMAP skips photos without one
        lens = ("OPENCV_FISHEYE", camera.distortion) if camera.model == "fisheye" else ("PINHOLE", ())
        params = (camera.fx, camera.fy, camera.cx, camera.cy, *lens[1])
        reader = pycolmap.ImageReaderOptions(camera_model=lens[0], camera_params=",".join(map(repr, params)))
        mode = pycolmap.CameraMode.PER_IMAGE
        pycolmap.import_images(database, work, image_names=[name], camera_mode=mode, options=reader)
        cameras[name] = camera
    return cameras
