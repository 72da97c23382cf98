"""The state of a training: everything that its iterations change."""

from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from numpy.typing import NDArray

from clsplat.config import InitConfig, TrainConfig
from clsplat.gaussians import Gaussians
from clsplat.inputs import Inputs
from clsplat.renderer import Renderer
from clsplat.scene import Scene, View
from clsplat.training import photo_exposures, photo_poses
from clsplat.training.autosize import rule
from clsplat.training.autosize.validation import can_validate
from clsplat.training.densify import STRATEGIES, Strategy
from clsplat.training.initialize import initialize
from clsplat.training.moving import Masks
from clsplat.training.optimizer import Moments, sh_degree_at
from clsplat.training.photo_parameters import PerPhoto
from clsplat.training.rows import Rows
from clsplat.training.smoothing_filter import SmoothingFilter

if TYPE_CHECKING:
    from clsplat.device import Device


@dataclass
class State:
    """Everything that training changes, which a checkpoint holds, and the scene's extent in world units.

    iteration: the last one done, counted from 1; seconds: training time. rows: on the device or on the host, as
    `move` placed them. intersections: the largest mean number of tiles per Gaussian that a view has had; it bounds
    the growth where memory does. losses: those of the iterations since the last line of the log. search: for the
    number of Gaussians; None where that is fixed. exposures, poses: parameters of the photos; None where they are not
    learned. filter: the 3D filter, if there is one. inputs: what the run trains on; iterations do not change it.
    moving: pixels of photos that do not train, as `clsplat.training.moving` finds them.
    """

    iteration: int
    seconds: float
    extent: float
    rows: Rows
    intersections: float = 0.0
    losses: list[float] = field(default_factory=list)
    search: rule.Search | None = None
    exposures: PerPhoto | None = None
    poses: PerPhoto | None = None
    filter: SmoothingFilter | None = None
    inputs: Inputs = field(default_factory=Inputs)
    moving: Masks = field(default_factory=dict)

    @property
    def gaussians(self) -> Gaussians:
        """The parameters that train."""
        return self.rows.gaussians

    @property
    def moments(self) -> Moments:
        """Adam's moments."""
        return self.rows.moments

    @property
    def strategy(self) -> Strategy:
        """The densification strategy."""
        return self.rows.strategy

    def move(self, device: "Device | None") -> None:
        """Place the rows on the device, or on the host for None."""
        self.rows = self.rows.on(device)

    def change_rows(self, rows: Rows) -> None:
        """Continue with other rows: their pixel sizes must be measured again."""
        self.rows = rows
        if self.filter:
            self.filter.forget()

    def fork(self, rows: Rows) -> "State":
        """A state with other rows that shares nothing with this one which training changes."""
        return replace(
            self,
            rows=rows,
            losses=[*self.losses],
            search=self.search and replace(self.search, most=len(rows.gaussians)),
            exposures=deepcopy(self.exposures),
            poses=deepcopy(self.poses),
            filter=self.filter and SmoothingFilter(),
        )

    def shown(self, renderer: Renderer) -> Gaussians:
        """The Gaussians where the renderer works, as they are rendered and saved: under the 3D filter, if any."""
        placed = renderer.place(self.gaussians)
        return self.filter.apply(renderer.stages, placed) if self.filter else placed

    def sh_degree(self, iteration: int, config: TrainConfig) -> int:
        """Degree of the spherical harmonics that is rendered and trained in an iteration."""
        return sh_degree_at(iteration, config.shortened(config.optim.sh_degree_every), self.gaussians.sh_degree)

    def corrected(self, views: list[View]) -> list[View]:
        """The views with the parameters of the photos applied: neutral colours and refined cameras."""
        if self.exposures:
            learned = self.exposures
            views = [view.changed(partial(_neutral, affine=learned.of(view.name).copy())) for view in views]
        if self.poses:
            motions = self.poses
            views = [v.with_camera(photo_poses.refined(v.camera, motions.of(v.name))) for v in views]
        return views


def _neutral(view: View, affine: NDArray[Any]) -> View:
    return replace(view, image=photo_exposures.neutral(view.image, affine))


def initial_state(scene: Scene, config: TrainConfig, gaussians: Gaussians | None = None) -> State:
    """The state before the first iteration, on the host, with the first Gaussians of `initialize` or with others."""
    if gaussians is None:
        gaussians = initialize(scene, start_config(config), config.seed, config.max_gaussians)
    strategy = STRATEGIES[config.strategy](config, scene.extent, len(gaussians))
    searches = config.size == "auto" and can_validate(scene.train)
    names = [view.name for view in scene.train]
    return State(
        iteration=0,
        seconds=0.0,
        extent=scene.extent,
        rows=Rows(gaussians, Moments.zeros(gaussians), strategy),
        search=rule.start(scene, len(gaussians), config) if searches else None,
        exposures=photo_exposures.start(names, config.response) if config.exposure else None,
        poses=photo_poses.start(names) if config.poses else None,
        filter=SmoothingFilter() if config.filter_3d else None,
    )


def start_config(config: TrainConfig) -> InitConfig:
    """Settings of the first Gaussians, those included that the configuration leaves to strategy and search."""
    init = config.init
    if init.opacity is None:
        init = replace(init, opacity=STRATEGIES[config.strategy].start_opacity)
    if init.random_points is None and config.size == "auto":
        init = replace(init, random_points=rule.RANDOM_START)
    return init
