"""What commands share: words to the user, the device, folders and files to write to."""

import json
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from clsplat.errors import InputError

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.gaussians import Gaussians

STARTED = time.perf_counter()  # of the command, but for the 0.2 s that Python takes to get here

loudness: Literal["quiet", "normal", "verbose"] = "normal"
"""What the user asked for by -q or -v; the command line sets it before a command runs."""

Out = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


def say(text: str) -> None:
    """Tell the user, unless quiet is asked for."""
    if loudness != "quiet":
        warn(text)


def warn(text: str) -> None:
    """Tell the user in any case, beside the progress bars."""
    if "tqdm" not in sys.modules:  # what takes a while to import is imported once it is needed
        print(text, file=sys.stderr, flush=True)
        return
    from tqdm import tqdm

    tqdm.write(text, sys.stderr)


def open_device(name: str | None, memory_limit: int | None = None) -> "Device":
    """The device the user asked for, named."""
    from clsplat.device import Device, select_device

    device = Device(select_device(name), memory_limit=memory_limit)
    say(f"device: {device.label}")
    return device


def new_folder(out: Path) -> None:
    """Create a folder, or say why it cannot be."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{out}: expected a folder that can be made, found: {error.strerror or error}") from error


def write_json(path: Path, value: Any) -> None:
    """Write a JSON file, whole or not at all."""
    from clsplat.atomic import replacing

    with replacing(path) as file:
        file.write((json.dumps(value, indent=2) + "\n").encode())


def moved(gaussians: "Gaussians", by: Any) -> "Gaussians":
    """The Gaussians translated by `by` (3,), in float64 until the end."""
    return replace(gaussians, means=(gaussians.means + by).astype(gaussians.means.dtype))


def say_cameras(dataset: Path, picture: Path) -> None:
    """Tell what structure from motion found, if it was ours, with warnings, and draw it."""
    from clsplat.dataset.sfm.summary import draw_cameras, preview

    found = preview(dataset)
    if found is None:
        return
    say(f"cameras: {found.summary()}")
    for warning in found.warnings():
        warn(f"warning: {warning}")
    draw_cameras(picture, found.model)
    say(f"cameras: {picture} shows them")


def say_scores(report: dict[str, Any], out: Path) -> None:
    """Tell the mean figures and where the page is."""
    from clsplat.show.evaluation_page import METRICS

    mean = ", ".join(f"{METRICS[name][0]} {value:.4g}" for name, value in report["mean"].items() if value is not None)
    say(f"held-out photos: {mean}; page: {out / 'index.html'}")
