"""Preparation of a training: the scene and the configuration as ``clsplat train`` uses them."""

from collections.abc import Callable
from dataclasses import fields, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import CoarseConfig, TrainConfig
from clsplat.dataset import load_scene, with_depth_maps, with_points
from clsplat.dataset.brightness import gains
from clsplat.dataset.finding import mask_folder
from clsplat.dataset.near_planes import with_near_planes
from clsplat.errors import InputError
from clsplat.ranges import check, parse_bytes
from clsplat.renderer import default_device
from clsplat.scene import Scene
from clsplat.training.densify import STRATEGIES
from clsplat.training.few_views import adapted, has_few
from clsplat.training.initialize import start_count
from clsplat.training.memory import Footprint
from clsplat.training.run_length import with_length
from clsplat.training.state import start_config

if TYPE_CHECKING:
    from clsplat.device import Device


def prepare(
    path: str | Path,
    config: TrainConfig,
    device: "Device | None" = None,
    *,
    scene: Scene | None = None,
    verbose: bool = False,
    tell: Callable[[str], None] = lambda text: None,
) -> tuple[Scene, TrainConfig]:
    """Load a dataset and adapt the configuration to it.

    Where the dataset has poses but no points, points are triangulated from its photos (`config.init.triangulate`).
    Photos that are brighter or darker than their neighbours are found (`config.even_brightness`).
    The number of iterations and the size of the first photos follow the photos, unless they are given. With few
    photos the configuration is adapted to them (`config.few`). `clsplat.training.loop.train` on the result does what
    ``clsplat train`` does.

    Parameters
    ----------
    path : str or Path
        The dataset's folder, as `clsplat.dataset.load_scene` reads it.
    config : TrainConfig
    device : Device, optional
        Device that will train; default: the one that `config` describes.
    scene : Scene, optional
        The dataset, if `load_scene` has read it already with `config.data`.
    verbose : bool
        Show COLMAP's own messages.
    tell : callable
        Called with a sentence about each step.

    Returns
    -------
    scene : Scene
    config : TrainConfig

    Raises
    ------
    InputError
        If a setting is out of range, the dataset cannot be read (the message has the file's name), or the first
        Gaussians do not fit the device's memory.
    """
    check_settings(config)
    if config.data.masks is not None:
        masks = _place(Path(path), mask_folder(Path(path), config.data.masks))
        config = replace(config, data=replace(config.data, masks=masks))
    if config.data.depth is not None:
        maps = _place(Path(path), mask_folder(Path(path), config.data.depth, "--depth"))
        config = replace(config, data=replace(config.data, depth=maps))
    if scene is None:
        scene = load_scene(path, config.data, verbose, photo_memory(config))
    scene = with_near_planes(scene)
    tell(f"scene: {len(scene.train)} photos to train on, {len(scene.test)} held out, {len(scene.points)} points")
    if config.data.downscale == "auto" and scene.downscale > 1:
        camera = scene.train[0].camera
        size = f"{camera.width}x{camera.height}"
        tell(f"photos: {size} pixels, reduced by {scene.downscale} (--downscale chooses another size)")
    if config.init.triangulate and not len(scene.points):
        scene = with_points(scene, path, config.data, verbose)
        found = f"{len(scene.points)} points, from photos and poses" if len(scene.points) else "random"
        tell(f"start: {found} (--init.no-triangulate: random)")
    if config.data.depth is not None:
        scene = with_depth_maps(scene, path, config.data, tell)
    if config.even_brightness and not config.exposure:
        scene = replace(scene, gains=gains(scene))
        if scene.gains:
            most = np.expm1(np.abs(np.log(list(scene.gains.values()))).max())
            tell(
                f"brightness: training photos differ from those taken next to them by up to {most:.0%}, and are "
                "evened out (--no-even-brightness: not)"
            )
    config = with_length(config, scene)
    few = adapted(config, scene)
    if few != config and not has_few(config, scene):
        tell("poses: no photo is held back to choose the number of Gaussians, as its pose would not be refined")
    elif few != config:
        left_out = ", and some Gaussians are left out of each image" if few.dropout > config.dropout else ""
        tell(
            f"few photos: none is held back to choose the number of Gaussians{left_out} "
            "(--few.below 0 trains as with many)"
        )
    check_memory(scene, few, device or open_device(config), tell)
    return scene, few


def check_settings(config: TrainConfig) -> None:
    """Raise an InputError if a setting is out of range, or has no effect without another one."""
    check(config)
    if config.response and not config.exposure:
        raise InputError("--response: expected with --exposure, whose maps it extends, found alone; add --exposure")


def _place(dataset: Path, folder: Path) -> str:
    """A folder as a setting: relative to the dataset if it is inside, so that both can move, otherwise absolute."""
    dataset, folder = dataset.resolve(), folder.resolve()
    return folder.relative_to(dataset).as_posix() if folder.is_relative_to(dataset) else str(folder)


def photo_memory(config: TrainConfig) -> int | None:
    """Bytes of decoded photos in the machine's memory; None without a limit."""
    return None if config.memory_limit is None else parse_bytes(config.memory_limit, "--memory-limit")


def check_memory(scene: Scene, config: TrainConfig, device: "Device", tell: Callable[[str], None]) -> None:
    """Check that the first Gaussians fit the device, and tell what the training takes.

    With blocks, the points need not fit: the coarse run starts from as many of them as do.
    """
    limit = device.memory_limit
    if config.memory_limit is not None:
        limit = min(limit, parse_bytes(config.memory_limit, "--memory-limit"))
    need, start = Footprint.of(scene, config, device), start_count(scene, start_config(config), config.max_gaussians)
    if config.blocks != 1:
        start = min(start, max(1, need.most_gaussians(limit)))
    need.check(start, limit, scene.downscale)
    tell(need.describe(start, config.max_gaussians, limit))


def of_fixed_size(config: TrainConfig, gaussians: int, rate: float) -> TrainConfig:
    """Configuration of a training that continues with trained Gaussians, and adds or removes none.

    Parameters
    ----------
    config : TrainConfig
    gaussians : int
        Number of the Gaussians.
    rate : float
        Factor on the first learning rate of the means.
    """
    still: dict[str, Any] = {}
    for name in STRATEGIES:
        settings = getattr(config, name)
        # Penalties would make Gaussians fade that no round replaces.
        penalties = {each.name: 0.0 for each in fields(settings) if each.name.endswith("_penalty")}
        still[name] = replace(settings, stop_fraction=0.0, **penalties)
    return replace(
        config,
        **still,
        size="fixed",
        max_gaussians=gaussians,
        optim=replace(config.optim, means_lr=rate * config.optim.means_lr, sh_degree_every=1),
        coarse=CoarseConfig(factor=1),
    )


def open_device(config: TrainConfig) -> "Device":
    """The device that `config.device` and `config.memory_limit` describe, opened once and kept.

    Raises
    ------
    InputError
        If the limit is not a number of bytes.
    DeviceError
        If there is no such device.
    """
    if config.device is None and config.memory_limit is None:
        return default_device()
    return _open(config.device, config.memory_limit)


@cache
def _open(name: str | None, memory_limit: str | None) -> "Device":
    from clsplat.device import Device, select_device

    limit = None if memory_limit is None else parse_bytes(memory_limit, "--memory-limit")
    return Device(select_device(name), memory_limit=limit)
