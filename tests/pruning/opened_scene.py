"""A trained scene with the views that price and evaluate it, as `clsplat compact` chooses them: for measurements."""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from clsplat.commands.compact import Compact
from clsplat.config import BACKGROUNDS, DataConfig, RenderConfig
from clsplat.dataset import load_scene
from clsplat.device import Device
from clsplat.formats import load_gaussians
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import View


@dataclass(frozen=True)
class Arguments:
    """Measure a scene."""

    scene: tyro.conf.Positional[Path]
    """File of Gaussians."""
    photos: Path | None = None
    """Dataset, as given to `train`; without it automatic viewpoints."""
    data: tyro.conf.OmitArgPrefixes[DataConfig] = field(default_factory=DataConfig)


def opened(arguments: Arguments) -> tuple[Gaussians, list[View], list[View], Renderer]:
    """The Gaussians, the views that price them, the views that evaluate them, and a renderer."""
    gaussians, mode, _ = load_gaussians(arguments.scene)
    renderer = Renderer(Device(), RenderConfig(mode=mode), BACKGROUNDS[arguments.data.background])
    scene = None if arguments.photos is None else load_scene(arguments.photos, arguments.data)
    command = Compact(arguments.scene, Path("-"), photos=arguments.photos, data_config=arguments.data)
    return gaussians, *command._views(gaussians, scene, renderer), renderer
