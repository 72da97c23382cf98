"""Triangulate points for datasets that have poses but no points, by COLMAP through pycolmap.

Features and matches are those of `clsplat.dataset.sfm.matching`; the poses are not changed (Schoenberger and Frahm
2016, section 4.2, doi:10.1109/CVPR.2016.445).
"""

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from clsplat.camera import Camera
from clsplat.dataset.sfm.matching import SEED, demand, extract, is_sliver, match, quiet
from clsplat.dataset.sfm.processes import apart
from clsplat.errors import InputError, unwritable
from clsplat.randomness import stream
from clsplat.scene import View

NEIGHBOURS = 10
"""Number of photos with which each photo is matched. COLMAP's sequential matching has the same default for the frames
of a video."""

ANGLE_MAX = np.pi / 3
"""Largest angle between the optical axes of two photos that are matched, rad. SIFT recognises points up to about half
this change of viewing direction. Off the axes, the viewing directions of the two photos can differ less than the axes
do."""

EDGE_MAX = 1000
"""Longer edge, in pixels, to which photos are reduced before features are detected. The time for matching grows with
the fourth power of it. Measurements: docs/howto/datasets.md."""

TRIANGULATED_MIN = 100
"""Smallest number of triangulated points that is used; fewer do not show where the scene is."""

POINTS_TARGET = 20_000
"""Number of points up to which `filled` adds points. Measurements: docs/howto/datasets.md."""

FILL_NEIGHBOURS = 8
"""Number of nearest points of a point, towards which points are added."""

POINTS = "points.npz"
"""File in the working folder with the points that were found."""

# Name of a photo, its camera model and parameters as COLMAP has them, and its viewmat.
Photo = tuple[str, str, list[float], list[list[float]]]


def pairs(cameras: list[Camera]) -> list[tuple[int, int]]:
    """Choose the pairs of photos to match: each with the nearest ones of similar viewing direction and other
    position.

    Parameters
    ----------
    cameras : list of Camera

    Returns
    -------
    list of (int, int)
        Indices of the cameras, the smaller one first, sorted.
    """
    positions = np.array([camera.position for camera in cameras]).reshape(-1, 3)
    axes = np.array([camera.viewmat[2, :3] for camera in cameras]).reshape(-1, 3)
    found = set()
    for i, (position, axis) in enumerate(zip(positions, axes, strict=True)):
        distances = np.linalg.norm(positions - position, axis=1)
        # The faces of a panorama have one position, apart from rounding: they cannot triangulate anything.
        elsewhere = distances > 1e-9 * np.abs(positions).max()
        distances = np.where(elsewhere & (axes @ axis > np.cos(ANGLE_MAX)), distances, np.inf)
        nearest = np.argsort(distances, kind="stable")[:NEIGHBOURS]
        found |= {(min(i, j), max(i, j)) for j in nearest.tolist() if np.isfinite(distances[j])}
    return sorted(found)


class Triangulated(NamedTuple):
    """Points that were triangulated.

    points (P, 3): positions in world units; P is 0 if fewer than `TRIANGULATED_MIN` were found; colors (P, 3): mean
    RGB of the points in the photos; shown: rows of the points whose features a photo has, by its name.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    shown: dict[str, NDArray[np.intp]]


def triangulate(views: Iterable[View], verbose: bool = False) -> Triangulated:
    """Triangulate points from photos with known poses.

    Parameters
    ----------
    views : iterable of View
        Photos with pinhole or fisheye cameras. They are read one after another and not kept, since photos may be
        large.
    verbose : bool
        Whether to show COLMAP's own messages.

    Returns
    -------
    Triangulated

    Raises
    ------
    InputError
        If a camera is neither a pinhole nor a fisheye, or temporary files cannot be written.
    """
    with TemporaryDirectory(prefix="clsplat_triangulate_", ignore_cleanup_errors=True) as folder:
        work = Path(folder)
        if problem := unwritable(work):
            raise InputError(f"cannot triangulate points: {work.parent} takes no files: {problem}")
        written = _write_photos(views, work)
        chosen = pairs([camera for _, camera in written.values()])
        if not chosen:
            return Triangulated(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), {})
        photos = [(file, *_lens(camera), camera.viewmat.tolist()) for file, (_, camera) in written.items()]
        apart("triangulate points", f"{__name__}:solve", work, photos=photos, chosen=chosen, verbose=verbose)
        with np.load(work / POINTS) as found:
            features = zip(found["files"].tolist(), found["rows"].tolist(), strict=True)
            shown: dict[str, set[int]] = {}
            for file, row in features:
                shown.setdefault(written[file][0], set()).add(row)
            rows = {name: np.array(sorted(each), np.intp) for name, each in shown.items()}
            return Triangulated(found["points"], found["colors"], rows)


def solve(work: Path, photos: list[Photo], chosen: list[tuple[int, int]], verbose: bool) -> None:
    """Triangulate points from the photos in a folder, and write them to `POINTS` in it.

    Parameters
    ----------
    work : Path
        The folder.
    photos : list
        Name, camera model of COLMAP, its parameters and viewmat of each photo.
    chosen : list of (int, int)
        Pairs to match, by their indices in `photos`.
    verbose : bool
        Whether to show COLMAP's own messages.
    """
    import pycolmap

    database = work / "database.db"
    viewmats = {name: np.array(viewmat) for name, _, _, viewmat in photos}
    names = list(viewmats)
    with quiet(verbose):
        pycolmap.Database.open(database).close()
        for name, lens, params, _ in photos:
            reader = pycolmap.ImageReaderOptions(camera_model=lens, camera_params=",".join(map(repr, params)))
            mode = pycolmap.CameraMode.PER_IMAGE
            pycolmap.import_images(database, work, image_names=[name], camera_mode=mode, options=reader)
        with pycolmap.Database.open(database) as opened:
            demand(work, names, [row.name for row in opened.read_all_images()])
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
                model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(viewmats[row.name][:3]))
        options = pycolmap.IncrementalPipelineOptions(random_seed=SEED, num_threads=1)
        (work / "model").mkdir()
        model = pycolmap.triangulate_points(model, database, work, work / "model", options=options)
    points = [point for _, point in sorted(model.points3D.items())]
    kept = points if len(points) >= TRIANGULATED_MIN else []
    seen = [(model.images[e.image_id].name, row) for row, point in enumerate(kept) for e in point.track.elements]
    np.savez(
        work / POINTS,
        points=np.array([point.xyz for point in kept]).reshape(-1, 3),
        colors=np.array([point.color for point in kept], np.uint8).reshape(-1, 3),
        files=np.array([file for file, _ in seen], str),
        rows=np.array([row for _, row in seen], int),
    )


def filled(points: NDArray[np.float64], colors: NDArray[np.uint8]) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Add points on the lines between neighbouring points, since features leave gaps where photos have little
    texture.

    Parameters
    ----------
    points : (P, 3) float64
        More than `FILL_NEIGHBOURS` points.
    colors : (P, 3) uint8

    Returns
    -------
    points, colors
        `POINTS_TARGET` points and their colours, the given ones first; unchanged if there are already as many.
    """
    from scipy.spatial import cKDTree

    missing = POINTS_TARGET - len(points)
    if missing <= 0:
        return points, colors
    rng = stream(SEED, "points between points")
    _, neighbours = cKDTree(points).query(points, k=FILL_NEIGHBOURS + 1)
    rows = rng.integers(0, len(points), missing)
    others = neighbours[rows, rng.integers(1, FILL_NEIGHBOURS + 1, missing)]  # the first is the point itself
    share = rng.uniform(size=(missing, 1))
    between = points[rows] + share * (points[others] - points[rows])
    blended = np.rint(colors[rows] + share * (colors[others].astype(float) - colors[rows])).astype(np.uint8)
    return np.concatenate([points, between]), np.concatenate([colors, blended])


def _lens(camera: Camera) -> tuple[str, list[float]]:
    """Camera model of COLMAP and its parameters."""
    fisheye = camera.model == "fisheye"
    more = camera.distortion if fisheye else ()
    params = [float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy, *more)]
    return "OPENCV_FISHEYE" if fisheye else "PINHOLE", params


def _write_photos(views: Iterable[View], work: Path) -> dict[str, tuple[str, Camera]]:
    """Write photos and masks as files for COLMAP.

    Returns
    -------
    dict of (str, Camera)
        Names and cameras of the photos by the name of the file.
    """
    written: dict[str, tuple[str, Camera]] = {}
    (work / "masks").mkdir()
    for number, view in enumerate(views):
        name, camera = f"{number:06}.png", view.camera
        if camera.model not in ("pinhole", "fisheye"):
            raise InputError(f"{view.name}: expected a pinhole or fisheye camera, found {camera.model}")
        if is_sliver(camera.width, camera.height, EDGE_MAX):
            continue
        try:
            # Temporary files: fast rather than small. COLMAP skips photos without a mask.
            Image.fromarray(view.image).save(work / name, compress_level=1)
            Image.fromarray(view.counts).save(work / "masks" / f"{name}.png")
        except OSError as error:
            raise InputError(
                f"cannot triangulate points: cannot write to {work.parent}: {error.strerror or error}"
            ) from error
        written[name] = view.name, camera
    return written
