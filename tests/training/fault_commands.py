"""The commands whose calls fail in turn (measure_faults.py), and facts about these calls."""

from pathlib import Path

from failing_calls import Point

from clsplat.dataset.sfm.reconstruction import WORK
from clsplat.resuming import CHECKPOINT

PHOTOS = 5
"""Photos of the dataset: one is held out."""

TRAIN = (
    *("train", "data", "-o", "out", "--iterations", "30", "--checkpoint-every", "10", "--eval-every", "10"),
    *("--init.random-points", "60", "--adc.start", "5", "--adc.every", "10", "--adc.grad-threshold", "1e-5"),
)
COMPACT = ("compact", "scene.ply", "-o", "out/small.spz", "--cameras", "data", "--max-gaussians", "55")
EXPOSURES = ("--exposure", "--filter-3d", "--strategy", "mcmc")
COMMANDS = {
    "train": TRAIN,
    "train exposures": (*TRAIN[:5], "6", "--checkpoint-every", "3", "--eval-every", "3", *TRAIN[10:12], *EXPOSURES),
    "eval": ("eval", "scene.ply", "data", "-o", "out"),
    "render": ("render", "scene.ply", "data", "-o", "out", "--depth"),
    "export": ("export", "scene.ply", "out/scene.sog"),
    "page": ("export", "scene.ply", "out/scene.html"),
    "compact": COMPACT,
    "sfm": ("sfm", "photos", "-o", "out", "--camera-model", "SIMPLE_RADIAL"),
}
"""Commands by name. Those that train go on with --resume where there is a checkpoint."""


def stays(name: str, point: Point) -> bool:
    """Whether a file is left since it could not be removed, or the folder of structure from motion that it is in; or
    it is the last checkpoint, without which a run ends well."""
    about = Path(point.about).name
    if CHECKPOINT in about and Path(name).name == CHECKPOINT:
        return True
    workspace = Path(name).parts[0].startswith(WORK) and about in (WORK, "lock")
    return point.kind in ("unlink", "open", "list") and (
        workspace or (point.kind == "unlink" and about == Path(name).name)
    )


def opens_device(point: Point) -> bool:
    """Whether a call is made only where a device is opened, or a program is built on it for the first time."""
    return point.kind in ("context", "queue", "build") or Path(point.about).suffix in (".cl", ".h")
