"""Functions that commands share: messages to the user, opening the device, writing folders and files."""

import json
import os
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from clsplat.errors import InputError, new_folder, unwritable

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.gaussians import Gaussians

STARTED = time.perf_counter()
"""Time at which the command started, s, except for the 0.2 s that Python takes to get here."""

loudness: Literal["quiet", "normal", "verbose"] = "normal"
"""Amount of output, as set by -q or -v before a command runs."""

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
"""Type of the flag --out, -o."""

OptionalOut = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]
"""Type of the flag --out, -o, where a run folder has a place for the result."""

SceneOrRun = Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SCENE|RUN")]
"""Type of the argument that names what was trained."""

DeviceName = Annotated[str | None, tyro.conf.arg(metavar="NAME")]
"""Type of the flag --device."""

Dataset = Annotated[tyro.conf.Positional[Path | None], tyro.conf.arg(metavar="[DATASET]")]
"""Type of the argument that names a dataset, which a run folder knows."""


class Terminated(KeyboardInterrupt):
    """SIGTERM ended a training as Ctrl-C does, with a checkpoint."""


def say(text: str) -> None:
    """Print a message for the user, unless -q was given."""
    if loudness != "quiet":
        warn(text)


def warn(text: str) -> None:
    """Print a message for the user in any case, without disturbing progress bars."""
    if "tqdm" not in sys.modules:  # there is no progress bar yet; importing tqdm takes time
        print(text, file=sys.stderr, flush=True)
        return
    from tqdm import tqdm

    tqdm.write(text, sys.stderr)


def open_device(name: str | None) -> "Device":
    """Open the requested device and print its name."""
    from clsplat.device import Device, select_device

    device = Device(select_device(name))
    say(f"device: {device.label}")
    return device


def try_folder(out: Path) -> None:
    """Raise an InputError if a folder cannot be created or no file can be written in it; nothing new remains."""
    missing = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    new_folder(out)
    problem = unwritable(out)
    for folder in missing:
        with suppress(OSError):
            folder.rmdir()
    if problem:
        raise InputError(f"cannot write to {out}: {problem}")


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file atomically."""
    from clsplat.atomic import replacing

    with replacing(path) as file:
        file.write((json.dumps(value, indent=2) + "\n").encode())


def moved(gaussians: "Gaussians", by: Any) -> "Gaussians":
    """Translate Gaussians by `by` (3,), computed in float64."""
    return replace(gaussians, means=(gaussians.means + by).astype(gaussians.means.dtype))


def say_cameras(dataset: Path) -> None:
    """Print the result of structure from motion, with warnings, if clsplat recovered the cameras."""
    from clsplat.dataset.sfm.summary import preview

    found = preview(dataset)
    if found is None:
        return
    say(f"cameras: {found.summary()}")
    for warning in found.warnings():
        warn(f"warning: {warning}")


def picture_cameras(dataset: Path, picture: Path) -> None:
    """Draw the result of structure from motion, if clsplat recovered the cameras."""
    from clsplat.dataset.sfm.reconstruction import read_record
    from clsplat.dataset.sfm.summary import draw_cameras, read_sparse

    if read_record(dataset) is not None:
        draw_cameras(picture, read_sparse(dataset / "sparse" / "0"))
        say(f"cameras: drawn in {picture}")


def say_scores(report: dict[str, Any], out: Path) -> None:
    """Print the mean metrics and the path of the evaluation page."""
    from clsplat.show.evaluation_page import METRICS

    mean = ", ".join(f"{METRICS[name][0]} {value:.4g}" for name, value in report["mean"].items() if value is not None)
    say(f"held-out photos: {mean}; page: {out / 'index.html'}")
