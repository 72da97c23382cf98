"""What is timed: Gaussians and a view of them, synthetic or from files."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.camera import Camera
from clsplat.config import DataConfig, Mode
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.scene import View

DEFAULT = ("10k-640x480", "100k-640x480", "1M-640x480", "100k-1280x720")
KNOBS_DEFAULT = "100k-640x480"
"""What is timed unless told otherwise."""

SCALING_GAUSSIANS = ("10k", "30k", "100k", "300k", "1M")
SCALING_SIZES = ("160x120", "320x240", "640x480", "1280x960", "1920x1440")
"""Of the charts: time against Gaussians at the third size, and against pixels with the third number of Gaussians."""

REFERENCE_COUNT = 100_000
SIZE_MEDIAN = 2.35
SIZE_SPREAD = 0.5
OPACITY_LOGIT_MEAN = -0.2
OPACITY_LOGIT_SPREAD = 2.0
"""With so many Gaussians at 640x480: median of their standard deviations in pixels, spread of its logarithm, mean and
spread of the logit of their opacities. Found by trial: 62 drawn pairs per pixel and 365 000 intersections with tiles
of 16x16, near what trained scenes have (Mip-NeRF 360's garden with 112 000 points at 648x420: 48 pairs)."""

SEED = 0


@dataclass(frozen=True, eq=False)
class Workload:
    """A view of some Gaussians; its photo is what training compares with.

    extent: of the scene, in world units; mode: what the Gaussians were trained for, if a file says it.
    """

    name: str
    gaussians: Gaussians
    view: View
    extent: float = 1.0
    mode: Mode | None = None


def scaling_names() -> list[str]:
    """Workloads of the charts."""
    names = [f"{count}-{SCALING_SIZES[2]}" for count in SCALING_GAUSSIANS]
    return names + [f"{SCALING_GAUSSIANS[2]}-{size}" for size in SCALING_SIZES if size != SCALING_SIZES[2]]


def synthetic(name: str) -> Workload:
    """The synthetic workload of a name such as 100k-640x480: number of Gaussians, width and height.

    The scene depends on the number alone: other sizes see it at another resolution, flatter ones less of its height.
    More Gaussians are smaller in proportion, as in a scene that is densified, so that pairs per pixel stay alike.

    Raises
    ------
    InputError
        If the name is of another form.
    """
    match = re.fullmatch(r"([1-9]\d*)(k|M)?-([1-9]\d*)x([1-9]\d*)", name)
    if match is None:
        raise InputError(
            f"--workloads: expected a number of Gaussians and an image size such as 100k-640x480, found {name!r}"
        )
    n = int(match[1]) * {None: 1, "k": 1000, "M": 1_000_000}[match[2]]
    width, height = int(match[3]), int(match[4])
    # A focal length of one width shows x/z and 4/3 y/z from -1/2 to 1/2 where the image is 4:3.
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), width, width, height)
    rng = np.random.default_rng(SEED)
    photo = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Workload(name, _scene(n), View(name, camera, photo))


def _scene(n: int) -> Gaussians:
    rng = np.random.default_rng(SEED)
    depths = rng.uniform(2, 6, (n, 1))
    slopes = rng.uniform(-0.5, 0.5, (n, 2)) * [1, 0.75]
    # The width of the image is one focal length and, in the reference, 640 pixels.
    median = SIZE_MEDIAN / 640 * np.sqrt(REFERENCE_COUNT / n)
    sh = rng.normal(0, 0.1, (n, 16, 3))
    sh[:, 0] = rng.normal(0, 0.8, (n, 3))
    return Gaussians(
        means=np.concatenate([slopes, np.ones((n, 1))], axis=1) * depths,
        log_scales=np.log(median * depths) + rng.normal(0, SIZE_SPREAD, (n, 3)),
        quats=rng.normal(size=(n, 4)),
        logit_opacities=rng.normal(OPACITY_LOGIT_MEAN, OPACITY_LOGIT_SPREAD, n),
        sh=sh,
    ).astype(np.float32)


def from_files(scene: Path, cameras: Path, views: int, data: DataConfig) -> list[Workload]:
    """Workloads of a trained scene: views spread evenly over a dataset's.

    Parameters
    ----------
    scene : Path
        File of Gaussians.
    cameras : Path
        Dataset, as `clsplat.dataset.load_scene` takes it.
    views : int
        How many of its views, at most; at least 1.
    data : DataConfig
        How the photos are read.

    Raises
    ------
    InputError
        If a file is missing or damaged, or `views` is less than 1.
    """
    from clsplat.dataset import load_scene
    from clsplat.formats import load_gaussians

    if views < 1:
        raise InputError(f"--views: expected 1 or more, found {views}")
    gaussians, mode, offset = load_gaussians(scene)
    dataset = load_scene(cameras, data)
    gaussians.means[:] = gaussians.means + (offset - dataset.offset)
    # The middles of equal parts.
    chosen = sorted({int((i + 0.5) * len(dataset.train) / views) for i in range(views)})
    return [
        Workload(f"{scene.stem}: {dataset.train[i].name}", gaussians, dataset.train[i], dataset.extent, mode)
        for i in chosen
    ]
