"""The command `info`: describe a file of Gaussians, a run or a dataset."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import tyro

from clsplat.commands.run_folders import SCENE, Run, is_run, read_run
from clsplat.config import TrainConfig
from clsplat.errors import InputError
from clsplat.ranges import flags_of
from clsplat.run_log import LOG
from clsplat.training.presets import read_settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from clsplat.gaussians import Gaussians

BAR = 40
"""Length of the longest bar of a histogram, in characters."""

BINS = 10
"""Number of bars of a histogram."""

LOG_SIZE_MAX = 700.0
"""Largest magnitude of a logarithm that is drawn: exp(700) is a float64, exp(710) is not."""


UNFINISHED = "none: the run is in progress or was interrupted; --resume finishes it"
"""Description of the result of a run that has none yet."""


@dataclass(frozen=True)
class Info:
    """Describe a file of Gaussians, the folder of a run, or a dataset."""

    path: tyro.conf.Positional[Path]
    """File of Gaussians in any format, folder written by `train`, or dataset."""

    def run(self) -> None:
        """Run the command."""
        from clsplat.formats import described_by

        if not self.path.exists():
            raise InputError(f"{self.path}: expected a file of Gaussians, a run or a dataset, found nothing")
        if self.path.is_dir() and described_by(self.path) is None:
            of_run = is_run(self.path) or (self.path / LOG).is_file()
            lines = run_lines(self.path) if of_run else dataset_lines(self.path)
        else:
            lines = scene_lines(self.path)
        print("\n".join(lines))


def scene_lines(path: Path) -> list[str]:
    """Describe a file of Gaussians."""
    from clsplat.formats import anatomy_of, load_gaussians

    gaussians, mode, offset = load_gaussians(path)
    anatomy = anatomy_of(path)
    size = bytes_of(path)
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    first, middle, last = np.percentile(gaussians.means, [1, 50, 99], axis=0)
    rows = {
        "format": anatomy.format,
        "Gaussians": f"{len(gaussians):,}",
        "sh degree": str(gaussians.sh_degree),
        "mode": mode,
        "size": f"{_size(size)}, {size / len(gaussians):.1f} bytes per Gaussian",
        "bounds": f"{_vector(low)} to {_vector(high)}",
        "98 % within": f"{_vector(first)} to {_vector(last)}",
        "middle": _vector(middle),
    }
    if offset.any():
        rows["offset"] = f"{_vector(offset, 10)}, to be added to obtain world coordinates"
    if anatomy.comments:
        rows["comments"] = "; ".join(anatomy.comments)
    title = "bytes by part, before compression" if anatomy.packed else "bytes by part"
    parts = {name: (_size(n), n) for name, n in anatomy.parts.items()}
    return [str(path), *_table(rows), "", title, *_bars(parts), "", *_histograms(gaussians)]


def bytes_of(path: Path) -> int:
    """Size of a file of Gaussians, or of all files that belong to a folder or to what describes one."""
    from clsplat.formats import anatomy_of, suffix_of

    return path.stat().st_size if suffix_of(path) and path.is_file() else sum(anatomy_of(path).parts.values())


def run_lines(folder: Path) -> list[str]:
    """Describe a folder written by `train`, whether the run is finished or not."""
    from clsplat.show.training_curve import read_log

    run = read_run(folder) if is_run(folder) else Run(None, TrainConfig())
    log = folder / LOG
    begun = log.is_file() and log.stat().st_size > 0
    last = read_log(log, ("iteration", "seconds"))[-1] if begun else {"iteration": 0, "seconds": 0.0}
    rows = {"what": f"a run of clsplat train --method {run.method}" if run.method else "a run of clsplat train"}
    if run.data is not None:
        rows["dataset"] = f"{run.data}{'' if run.data.exists() else ', missing'}"
    total = f" of {run.config.iterations:,}" if is_run(folder) else ""
    rows["iterations"] = f"{last['iteration']:,}{total}"
    rows["time"] = f"{last['seconds']:.0f} s"
    rows |= _scores(folder, last)
    if changed := flags_of(run.config, TrainConfig(iterations=run.config.iterations)):
        rows["settings"] = " ".join(changed)
    if run.method or (begun and "num_gaussians" not in last):
        return [str(folder), *_table(rows | _model(folder))]
    scene = folder / SCENE
    if not scene.is_file():
        rows |= {"Gaussians": f"{last['num_gaussians']:,}"} if begun else {}
        rows[SCENE] = UNFINISHED
        return [str(folder), *_table(rows)]
    return [str(folder), *_table(rows), "", *scene_lines(scene)]


def _model(folder: Path) -> dict[str, str]:
    """Row of the file of a radiance field."""
    from clsplat.fields.field_files import MODEL

    file = folder / MODEL
    return {MODEL: _size(file.stat().st_size) if file.is_file() else UNFINISHED}


def _scores(folder: Path, last: Mapping[str, Any]) -> dict[str, str]:
    """Rows of the metrics of held-out photos: those of the evaluation, or the last PSNR of the log."""
    from clsplat.show.evaluation_page import METRICS

    metrics = folder / "eval" / "metrics.json"
    if not metrics.is_file():
        return {} if last.get("psnr") is None else {"held-out PSNR": f"{last['psnr']:.2f} dB"}
    mean = read_settings(metrics).get("mean")
    if not isinstance(mean, dict):
        raise InputError(f"{metrics}: expected the metrics of an evaluation, found no means")
    numbers = {name: mean.get(name) for name in METRICS}
    return {
        f"held-out {METRICS[name][0]}": f"{value:.{METRICS[name][2]}f} {METRICS[name][1]}".rstrip()
        for name, value in numbers.items()
        if isinstance(value, float)
    }


def dataset_lines(path: Path) -> list[str]:
    """Describe a dataset, without recovering its cameras."""
    from clsplat.config import DataConfig
    from clsplat.dataset import colmap
    from clsplat.dataset.finding import PhotosMissing
    from clsplat.dataset.loading import COLMAP, PHOTOS, TRANSFORMS, detect
    from clsplat.dataset.photos import list_photos, photo_folder, photo_size
    from clsplat.dataset.sfm import reconstruction as sfm

    record, model = sfm.read_record(path), colmap.find_model(path)
    source = sfm.recorded_photos(path, record) if record else path
    photos = [photo_folder(source) / name for name in list_photos(source)]
    try:
        what, dataset = detect(path, DataConfig(downscale=1))
    except PhotosMissing:
        if model is None:
            what, dataset = detect(path, DataConfig())  # the copies, if there are any
        else:
            what, dataset, photos = COLMAP, None, []
    if dataset is not None:
        photos = [photo.path for photo in dataset.photos]
    if what == TRANSFORMS and dataset is not None:
        lenses, points, model = [photo.intrinsics for photo in dataset.photos], dataset.points, None
    elif model is not None:
        cameras, posed, points, *_ = colmap.read_model(model)
        lenses = [cameras[camera] for _, camera, _ in posed]
    elif photos:
        lenses, points, what = [], np.empty((0, 3)), f"{PHOTOS}: train or sfm recovers them"
    else:
        raise InputError(f"{path}: expected a scene, a run or a dataset, found neither photos nor cameras")
    rows = {"what": what, "photos": f"{len(photos):,}"}
    smaller = {f: list_photos(source / f) for f in ("images_2", "images_4", "images_8") if (source / f).is_dir()}
    if smaller:
        rows["smaller copies"] = ", ".join(f"{len(files):,} in {name}" for name, files in smaller.items())
    if photos:
        rows["sizes"] = _counts(Counter("{}x{}".format(*photo_size(photo)) for photo in photos))
    if model is not None:
        rows["model"] = str(model)
    if lenses:
        rows["poses"] = f"{len(lenses):,}"
        rows["cameras"] = _counts(Counter(f"{lens.model} {lens.width}x{lens.height}" for lens in lenses))
        rows["points"] = f"{len(points):,}"
    if len(points):
        first, last = np.percentile(points, [1, 99], axis=0)
        rows["98 % within"] = f"{_vector(first)} to {_vector(last)}"
    return [str(path), *_table(rows)]


def _histograms(gaussians: "Gaussians") -> list[str]:
    opacities = _histogram(gaussians.opacities, np.linspace(0, 1, BINS + 1))
    logs = gaussians.log_scales.mean(axis=1, dtype=np.float64)
    sizes = np.exp(np.clip(logs, -LOG_SIZE_MAX, LOG_SIZE_MAX))
    low, high = np.percentile(sizes, [0.5, 99.5])
    edges = np.geomspace(low, max(high, low * 1.01), BINS + 1)
    return [
        "opacity",
        *_bars(opacities),
        "",
        "size: geometric mean of the standard deviations; outliers count in the outermost bars",
        *_bars(_histogram(sizes, edges)),
    ]


def _histogram(values: "NDArray[Any]", edges: "NDArray[Any]") -> dict[str, tuple[str, int]]:
    """Compute share, as text, and count of the values in each range."""
    bins = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)
    counts = np.bincount(bins, minlength=len(edges) - 1)
    return {
        f"{low:.3g} to {high:.3g}": (f"{100 * count / len(values):.1f} %", int(count))
        for low, high, count in zip(edges, edges[1:], counts, strict=False)
    }


def _bars(rows: Mapping[str, tuple[str, int]]) -> list[str]:
    """Format rows (text, number) as lines with name, text, and a bar proportional to the number."""
    top = max((value for _, value in rows.values()), default=0)
    figures = {name: text for name, (text, _) in rows.items()}
    width = max(map(len, figures.values()), default=0)
    left = max(map(len, figures), default=0)
    return [
        f"  {name:<{left}}  {text:>{width}}  {'#' * round(BAR * rows[name][1] / max(top, 1))}".rstrip()
        for name, text in figures.items()
    ]


def _table(rows: Mapping[str, str]) -> list[str]:
    width = max(map(len, rows))
    return [f"  {name:<{width}}  {value}" for name, value in rows.items()]


def _counts(counts: Mapping[str, int]) -> str:
    """Format counts, the largest first."""
    return ", ".join(f"{count:,} of {name}" for name, count in sorted(counts.items(), key=lambda x: -x[1]))


def _vector(values: Iterable[float], digits: int = 4) -> str:
    return "(" + ", ".join(f"{v + 0.0:.{digits}g}" for v in values) + ")"  # + 0.0 turns -0 to 0


def _size(count: int) -> str:
    return f"{count / 1e6:.3g} MB" if count >= 1e6 else f"{count / 1e3:.3g} kB" if count >= 1000 else f"{count} bytes"
