"""The training of a radiance field by `clsplat train --method`."""

from collections.abc import Iterator
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.commands import console
from clsplat.commands.console import say, say_scores, write_json
from clsplat.commands.run_folders import CONFIG, extracted
from clsplat.config import BACKGROUNDS, TrainConfig
from clsplat.errors import InputError
from clsplat.training.presets import DATA_PATH, METHOD

if TYPE_CHECKING:
    from clsplat.device import Device
    from clsplat.fields import Field
    from clsplat.scene import Scene, View

COUNTED = ("iterations", "seed", "checkpoint_every", "eval_every", "device", "memory_limit", "data")
"""Settings that count for a field."""


def check_settings(method: str, config: TrainConfig) -> None:
    """Raise an InputError if a setting is given that only Gaussians have."""
    default = TrainConfig()
    names = [f.name for f in fields(config) if getattr(config, f.name) != getattr(default, f.name)]
    others = [name for name in names if name not in COUNTED] + ["depth"] * (config.data.depth is not None)
    if others:
        raise InputError(
            f"--method {method}: expected no settings of Gaussians, found {', '.join(others)}; leave them out"
        )


def check_photos(data: Path, scene: "Scene", config: TrainConfig) -> None:
    """Raise an InputError if the decoded photos of a scene exceed the memory for them."""
    from clsplat.streaming import photo_budget
    from clsplat.training.memory import bytes_text
    from clsplat.training.preparation import photo_memory

    need = sum(_bytes_of(view) for view in scene.train + scene.test)
    budget = photo_budget(photo_memory(config))
    if budget is None or need <= budget:
        return
    if config.memory_limit is not None:
        raise InputError(
            f"--memory-limit: expected at least {bytes_text(need)} for the photos, as a field trains on all pixels "
            f"at once, found {bytes_text(budget)}; raise it or --downscale"
        )
    raise InputError(
        f"{data}: expected photos that fit {bytes_text(budget)}, half of this machine, as a field trains on all "
        f"pixels at once, found {bytes_text(need)}; use a higher --downscale"
    )


def _bytes_of(view: "View") -> int:
    """Bytes of a photo, and of the places of its pixels that count if it has a mask (`clsplat.fields.pixels`)."""
    each = 3 + (view.clear is not None) + 5 * (view.mask is not None)
    return each * view.camera.width * view.camera.height


def images_of(field: "Field", views: "list[View]", config: TrainConfig) -> Iterator[NDArray[np.uint8]]:
    """Render views in 8 bits, one after the other."""
    from clsplat.metrics import to_uint8

    for view in views:
        yield to_uint8(field.image(view.camera, BACKGROUNDS[config.data.background]))


def train_and_evaluate(
    data: Path, method: str, config: TrainConfig, device: "Device", out: Path, resume: bool
) -> None:
    """Train a field with a progress bar, and write its file, log, and evaluation to `out`.

    Ctrl-C and SIGTERM end the training after an iteration, with a checkpoint.
    """
    from tqdm import tqdm

    from clsplat.commands.progress import Stop
    from clsplat.dataset import load_scene
    from clsplat.evaluate import evaluate_images, mean_metrics_of
    from clsplat.fields import METHODS
    from clsplat.fields.field_files import MODEL
    from clsplat.fields.field_training import train_field
    from clsplat.training.preparation import photo_memory

    kind = METHODS[method]
    config = replace(config, iterations=config.iterations or kind.iterations)
    photos = replace(config.data, random_background=True)
    verbose = console.loudness == "verbose"
    scene = load_scene(extracted(data, out), photos, verbose, photo_memory(config))
    check_photos(data, scene, config)
    if not resume:
        write_json(out / CONFIG, {DATA_PATH: str(data.resolve()), METHOD: method, **asdict(config)})
    every = config.eval_every or config.iterations

    def evaluated(field: "Field") -> dict[str, Any]:
        if not scene.test or field.iteration % every or field.iteration == config.iterations:
            return {}
        return mean_metrics_of(images_of(field, scene.test, config), scene.test)

    stop = Stop(out)
    with stop.awaited(), tqdm(total=config.iterations, unit="it", dynamic_ncols=True) as bar:

        def progress(record: dict[str, Any]) -> None:
            bar.update(record["iteration"] - bar.n)
            bar.set_postfix_str(f"loss={record['loss']:.4f}, rays={record['rays']}", refresh=False)
            stop.after(record["iteration"])

        field = train_field(
            scene,
            kind,
            config,
            out,
            device,
            resume=resume,
            evaluate=evaluated,
            progress=progress,
        )
    size = (out / MODEL).stat().st_size
    say(f"{out / MODEL}: {size / 1e6:.3g} MB")
    if scene.test:
        about = {"method": method, "model_bytes": size}
        images = images_of(field, scene.test, config)
        say_scores(evaluate_images(images, scene.test, out / "eval", about, device.label), out / "eval")
