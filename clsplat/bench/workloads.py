"""Workloads of measurements: Gaussians and a view of them, synthetic or from files."""

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
FRAMES_DEFAULT = ("10k-640x480", "100k-640x480", "300k-640x480", "100k-1280x720")
"""Default workloads of `clsplat bench kernels`, `clsplat bench knobs` and `clsplat bench viewer`."""

SCALING_GAUSSIANS = ("10k", "30k", "100k", "300k", "1M")
SCALING_SIZES = ("160x120", "320x240", "640x480", "1280x960", "1920x1440")
"""Workloads of the scaling chart: time against Gaussians at the third size, and time against pixels with the third
number of Gaussians."""

REFERENCE_COUNT = 100_000
SIZE_MEDIAN = 2.35
SIZE_SPREAD = 0.5
OPACITY_LOGIT_MEAN = -0.2
OPACITY_LOGIT_SPREAD = 2.0
"""Synthetic scenes, at REFERENCE_COUNT Gaussians and 640x480 px: median of the Gaussians' standard deviations, px,
spread of its logarithm, and mean and spread of the logit of the opacities. Found by trial, so that the numbers of
pairs per pixel and of intersections are similar to those of trained scenes (docs/benchmarks.md)."""

SEED = 0
"""Seed of the random numbers."""


@dataclass(frozen=True, eq=False)
class Workload:
    """A view of Gaussians, with the photo for the training step.

    `extent` is the extent of the scene, world units. `mode` is the mode that the Gaussians were trained for, if
    known.
    """

    name: str
    gaussians: Gaussians
    view: View
    extent: float = 1.0
    mode: Mode | None = None


def scaling_names() -> list[str]:
    """Names of the workloads of the scaling chart."""
    names = [f"{count}-{SCALING_SIZES[2]}" for count in SCALING_GAUSSIANS]
    return names + [f"{SCALING_GAUSSIANS[2]}-{size}" for size in SCALING_SIZES if size != SCALING_SIZES[2]]


def synthetic(name: str) -> Workload:
    """The synthetic workload with a name such as 100k-640x480: number of Gaussians, width and height.

    The scene depends only on the number. Other image sizes show it at another resolution, and flatter images show
    less of its height. With more Gaussians, each is smaller, as in a densified scene, so that the number of pairs per
    pixel stays similar.

    Raises
    ------
    InputError
        If the name has another form.
    """
    match = re.fullmatch(r"([1-9]\d*)(k|M)?-([1-9]\d*)x([1-9]\d*)", name)
    if match is None:
        raise InputError(
            f"--workloads: expected a number of Gaussians and an image size such as 100k-640x480, found {name!r}"
        )
    n = int(match[1]) * {None: 1, "k": 1000, "M": 1_000_000}[match[2]]
    width, height = int(match[3]), int(match[4])
    # With a focal length of one width, a 4:3 image shows x/z and 4/3 y/z from -1/2 to 1/2.
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), width, width, height)
    rng = np.random.default_rng(SEED)
    photo = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    return Workload(name, _scene(n), View(name, camera, photo))


def _scene(n: int) -> Gaussians:
    rng = np.random.default_rng(SEED)
    depths = rng.uniform(2, 6, (n, 1))
    slopes = rng.uniform(-0.5, 0.5, (n, 2)) * [1, 0.75]
    # The width of the image is one focal length, which is 640 px in the reference.
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
    """Workloads of a trained scene, with views spread evenly over those of a dataset.

    Parameters
    ----------
    scene : Path
        File of Gaussians.
    cameras : Path
        Dataset, as for `clsplat.dataset.load_scene`.
    views : int
        Largest number of views, at least 1.
    data : DataConfig
        Options for reading the photos.

    Raises
    ------
    InputError
        If a file is missing or damaged.
    """
    from clsplat.dataset import load_scene
    from clsplat.formats import load_gaussians

    gaussians, mode, offset = load_gaussians(scene)
    dataset = load_scene(cameras, data)
    gaussians.means[:] = gaussians.means + (offset - dataset.offset)
    # The middle view of each of `views` equal parts.
    chosen = sorted({int((i + 0.5) * len(dataset.train) / views) for i in range(views)})
    return [
        Workload(f"{scene.stem}: {dataset.train[i].name}", gaussians, dataset.train[i], dataset.extent, mode)
        for i in chosen
    ]
