"""Settings that commands share: parts of configurations that have an effect on a command, and those of the viewer."""

from dataclasses import dataclass, field
from typing import Annotated

import tyro

from clsplat.config import DataConfig, Downscale, Mode, RenderConfig, SfmConfig
from clsplat.ranges import within

COORDINATE_MAX = 1e18
"""Largest coordinate: its square is finite in single precision."""


@dataclass(frozen=True)
class PhotoOptions(DataConfig):
    """Settings of the photos that a scene is compared with. Their cameras are those that the scene was trained on."""

    random_background: tyro.conf.Fixed[bool] = False
    depth: tyro.conf.Fixed[str | None] = None
    sfm: tyro.conf.Fixed[SfmConfig] = field(default_factory=SfmConfig)
    triangulate: tyro.conf.Fixed[bool] = True
    """Whether points are triangulated where the dataset has none, as in the training."""


@dataclass(frozen=True)
class CameraOptions(PhotoOptions):
    """Settings of cameras from which a scene is rendered."""

    masks: tyro.conf.Fixed[str | None] = None
    invert_masks: tyro.conf.Fixed[bool] = False


@dataclass(frozen=True)
class ViewOptions(CameraOptions):
    """Settings of a view of a scene, which shows training photos and held-out ones alike."""

    test_every: tyro.conf.Fixed[Annotated[int, within(least=0)]] = 8


@dataclass(frozen=True)
class PageOptions(ViewOptions):
    """Settings of a web page, which has no photos."""

    downscale: tyro.conf.Fixed[Downscale] = "auto"


@dataclass(frozen=True)
class DrawOptions(RenderConfig):
    """Settings of rendering a file of Gaussians, which knows its mode."""

    mode: tyro.conf.Fixed[Mode] = "classic"


@dataclass(frozen=True)
class ViewerDrawOptions(DrawOptions):
    """Settings of the viewer, whose cameras have no near planes of their own."""

    near: Annotated[float | None, within(above=0)] = None
    """Depth up to which nothing is drawn, world units. Default: by the size of the scene."""


@dataclass(frozen=True)
class PlaceOptions:
    """Another place of a scene that is exported: it is scaled, then turned, then moved."""

    scale: Annotated[float, within(above=0)] = 1.0
    """Factor on all lengths, for example to metres."""
    rotate: Annotated[tuple[float, float, float], within(least=-360, most=360)] = (0.0, 0.0, 0.0)
    """Angles about the axes x, y and z, degrees; the scene is turned about x first. 180 0 0 turns it upside down."""
    move: Annotated[tuple[float, float, float], within(least=-COORDINATE_MAX, most=COORDINATE_MAX)] = (0.0, 0.0, 0.0)
    """Distances along x, y and z, in units of the scaled scene."""


@dataclass(frozen=True)
class ServerOptions:
    """Settings of the viewer's server."""

    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address that the viewer listens on; 0.0.0.0 admits other machines, with the token in the printed address."""
    port: Annotated[int, within(least=0, most=65535)] = 8080
    """Port that the viewer listens on; if it is in use, the next free one."""
    open: bool = False
    """Open the viewer in the browser of this machine."""


@dataclass(frozen=True)
class ClusterOptions:
    """Settings of the machines on which blocks train."""

    scheduler: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Scheduler of dask whose workers train the blocks, such as tcp://host:8786; needs the extra `cluster`."""
    print_jobs: bool = False
    """Print the commands that train the blocks, for a batch system, and stop. When they have run, repeat the command
    with --resume: the first two times it prints the commands of later trainings, the next time it joins the
    blocks."""
