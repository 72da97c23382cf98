"""Summary of a structure from motion before training: figures, warnings, and a picture of the cameras."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from clsplat.atomic import replacing
from clsplat.dataset import colmap
from clsplat.dataset.photos import list_photos, photo_folder, photo_sharpness
from clsplat.dataset.sfm.reconstruction import read_record
from clsplat.errors import InputError, named

ERROR_MAX = 1.5
"""Mean reprojection error above which a warning is given, px. Values of real scenes: docs/howto/photos.md."""

TRACK_MIN = 2.5
"""Mean number of photos per point below which a warning is given. The smallest possible value is 2: no third photo
confirms the points. Values of real scenes: docs/howto/photos.md."""

POINTS_MIN = 50
"""Number of points in a photo below which its pose is reported as doubtful. COLMAP registers a photo from 30 points
on (abs_pose_min_num_inliers)."""

BLUR_MAX = 0.3
"""Sharpness, as a fraction of the median of all photos, below which a photo is reported as blurred. Values of real
scenes: docs/howto/photos.md."""

LISTED = 10
"""Largest number of photos that a warning names; further ones are counted."""

PICTURE_POINTS = 20_000
"""Approximate number of points in the picture."""


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Poses and points of a COLMAP model, for summaries and pictures.

    Parameters
    ----------
    names : list of str
        Names of the V photos with a pose, sorted.
    positions, directions : (V, 3) float64
        Positions of the cameras in world units, and their viewing directions as unit vectors.
    points_seen : (V,) int
        Number of points of the model in each photo.
    points : (P, 3) float64
        Sparse points in world units.
    colors : (P, 3) uint8
        RGB of the points.
    error : float
        Mean reprojection error, in pixels of the matched photos.
    track_length : float
        Mean number of photos per point.
    """

    names: list[str]
    positions: NDArray[np.float64]
    directions: NDArray[np.float64]
    points_seen: NDArray[np.int64]
    points: NDArray[np.float64]
    colors: NDArray[np.uint8]
    error: float
    track_length: float


def read_sparse(model: Path) -> SparseModel:
    """Read a COLMAP model in its binary or text format.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    import pycolmap

    colmap.read_model(model)  # COLMAP itself allocates and loops as often as a damaged file declares
    try:
        with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            # Without rigs and frames: nothing else checks their counts, and nothing here needs them.
            for path in model.iterdir():
                if path.stem in ("cameras", "images", "points3D"):
                    shutil.copy(path, folder)
            found = pycolmap.Reconstruction(folder)
        images = sorted((i for i in found.images.values() if i.has_pose), key=lambda image: image.name)
        poses = [image.cam_from_world() for image in images]
        points = list(found.points3D.values())
        result = SparseModel(
            [image.name for image in images],
            np.array([pose.inverse().translation for pose in poses]).reshape(-1, 3),
            np.array([pose.rotation.matrix()[2] for pose in poses]).reshape(-1, 3),
            np.array([image.num_points3D for image in images]),
            np.array([point.xyz for point in points]).reshape(-1, 3),
            np.array([point.color for point in points], np.uint8).reshape(-1, 3),
            float(found.compute_mean_reprojection_error()),
            float(found.compute_mean_track_length()),
        )
    # COLMAP raises errors of many kinds on damaged files: IndexError, RuntimeError, MemoryError ...
    except Exception as error:
        raise InputError(f"cannot read {model} as a COLMAP model: {error}") from error
    if not all(np.isfinite(array).all() for array in (result.positions, result.directions, result.points)):
        raise InputError(f"{model}: expected finite poses and points, found others")
    return result


@dataclass(frozen=True, eq=False)
class Preview:
    """The result of structure from motion.

    Parameters
    ----------
    photos : list of str
        Names of all photos.
    model : SparseModel
        Poses and points.
    sharpness : (len(photos),) float
        Sharpness of each photo, measured by `clsplat.dataset.photos.photo_sharpness`.
    """

    photos: list[str]
    model: SparseModel
    sharpness: NDArray[np.float64]

    def summary(self) -> str:
        """Describe the model in one line."""
        m = self.model
        return (
            f"{len(m.names)} of {len(self.photos)} photos have a pose; {len(m.points):,} points, each seen in "
            f"{m.track_length:.1f} photos; mean reprojection error {m.error:.2f} px"
        )

    def warnings(self) -> list[str]:
        """List problems of photos and poses, each with a remedy; empty if there are none."""
        m, found = self.model, []
        posed = set(m.names)
        missing = [name for name in self.photos if name not in posed]
        if missing:
            found.append(
                f"no pose was found for {self._share(missing)}; they are not trained on. They overlap too little "
                "with the others, are blurred, or lack texture; take photos in between"
            )
        least = BLUR_MAX * np.median(self.sharpness) if self.photos else 0
        blurred = [name for name, value in zip(self.photos, self.sharpness, strict=True) if value < least]
        if blurred:
            found.append(f"blurred compared with the others: {self._share(blurred)}; leave them out")
        weak = [name for name, count in zip(m.names, m.points_seen, strict=True) if count < POINTS_MIN]
        if weak:
            found.append(f"poses are doubtful, from fewer than {POINTS_MIN} points: {self._share(weak)}")
        if m.track_length < TRACK_MIN:
            found.append(
                f"points are seen in {m.track_length:.1f} photos on average: photos overlap too little; neighbouring "
                "photos should overlap by two thirds"
            )
        if m.error > ERROR_MAX:
            found.append(
                f"the mean reprojection error of {m.error:.1f} px is large: something moved, the zoom changed "
                "(--sfm.no-single-camera), or the lens needs another --sfm.camera-model"
            )
        return found

    def _share(self, names: list[str]) -> str:
        return f"{len(names)} of {len(self.photos)} photos: {named(names, LISTED)}"


def preview(dataset: Path) -> Preview | None:
    """Read the model that `reconstruct` made for `dataset`, and measure the sharpness of the photos.

    Returns
    -------
    Preview or None
        None if the cameras of the dataset were not recovered by `reconstruct`.

    Raises
    ------
    InputError
        If the record, the model or a photo is damaged.
    """
    record = read_record(dataset)
    if record is None:
        return None
    photos = dataset / record["photos"]
    names = list_photos(photos)
    with ThreadPoolExecutor() as pool:
        values = list(pool.map(lambda name: photo_sharpness(photo_folder(photos) / name), names))
    return Preview(names, read_sparse(dataset / "sparse" / "0"), np.array(values))


def draw_cameras(path: Path, model: SparseModel) -> None:
    """Write a PNG with the cameras and points of a model, from above and from the side.

    Parameters
    ----------
    path : Path
        The file to write.
    model : SparseModel
        Model whose y axis points down.

    Raises
    ------
    InputError
        If the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.5), dpi=120, layout="constrained")
    chosen = np.arange(len(model.points))[:: -(-len(model.points) // PICTURE_POINTS) or 1]
    everything = np.concatenate([model.positions, model.points[chosen]])
    low, high = np.percentile(everything, [3, 97], axis=0)
    low, high = np.minimum(low, model.positions.min(axis=0)), np.maximum(high, model.positions.max(axis=0))
    reach = 0.55 * float((high - low).max())
    middle = (low + high) / 2
    for axes, title, (across, up), signs in zip(
        figure.subplots(1, 2), ("from above", "from the side"), ((0, 2), (0, 1)), ((1, 1), (1, -1)), strict=True
    ):
        points = model.points[chosen][:, [across, up]] * signs
        axes.scatter(*points.T, c=model.colors[chosen] / 255, s=1.5, linewidths=0)
        eyes, gazes = (x[:, [across, up]] * signs for x in (model.positions, model.directions))
        style = {"color": "#d55e00", "angles": "xy", "scale_units": "xy", "width": 0.004, "zorder": 3}
        axes.quiver(*eyes.T, *gazes.T, scale=1 / (0.12 * reach), **style)
        axes.plot(*eyes.T, "o", color="#d55e00", markersize=4, zorder=4)
        centre = middle[[across, up]] * signs
        axes.set_xlim(centre[0] - reach, centre[0] + reach)
        axes.set_ylim(centre[1] - reach, centre[1] + reach)
        axes.set_aspect("equal")
        axes.set_title(title, fontsize="medium")
        axes.tick_params(labelsize="small")
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{len(model.names)} cameras (orange, arrow: viewing direction), {len(model.points):,} points")
    with replacing(path) as file:
        figure.savefig(file, format="png", metadata={"Software": None})
