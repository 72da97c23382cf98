"""The optimiser: Adam on the device or in NumPy, its moments, and the schedules of the learning rates."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from clsplat import reference
from clsplat.config import OptimConfig
from clsplat.gaussians import Gaussians
from clsplat.renderer import Pass, Renderer, download, fetch
from clsplat.stages import AdamStep, AnyGrads, CameraGrads, Stages
from clsplat.training.smoothing_filter import SmoothingFilter

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

FALL = 0.6
"""Fraction of the iterations after which the learning rates, except that of the means, fall (measured:
docs/experiments/schedules.md)."""


@dataclass
class Moments:
    """Adam's running means of the gradients and of their squares, one row per Gaussian."""

    first: Gaussians
    second: Gaussians

    @classmethod
    def zeros(cls, gaussians: Gaussians) -> "Moments":
        """Moments before the first step on `gaussians`."""
        first, second = (Gaussians(**{k: np.zeros_like(a) for k, a in gaussians.arrays().items()}) for _ in range(2))
        return cls(first, second)

    def take(self, rows: Array) -> "Moments":
        """Copies of some rows, on the host."""
        return Moments(self.first.take(rows), self.second.take(rows))


def sh_degree_at(iteration: int, every: int, stored: int) -> int:
    """Degree of the spherical harmonics that is rendered and trained in an iteration, counted from 1.

    It rises by one after every `every` iterations, up to the degree that is stored.
    """
    return min(stored, (iteration - 1) // every)


def adam_settings(
    iteration: int,
    progress: float,
    extent: float,
    config: OptimConfig,
    sh_degree: int,
    penalties: tuple[float, float, float] = (0.0, 0.0, 0.0),
    factor: float = 1.0,
) -> AdamStep:
    """Learning rates and constants of an iteration.

    Parameters
    ----------
    iteration : int
        Counted from 1.
    progress : float
        Fraction of the training, 0 to 1; means_lr_final and rates_final are reached at 1.
    extent : float
        Scale of the scene, world units; the learning rate of the means is proportional to it.
    sh_degree : int
        Highest degree of the spherical harmonics that is trained.
    penalties : three floats
        Weights in the loss of the sums of opacities, of scales, and of the penalties of needles.
    factor : float
        Factor on all learning rates.
    """
    fallen = factor * config.rates_final ** max(0.0, (progress - FALL) / (1 - FALL))
    rates = {
        "means": factor * extent * config.means_lr * (config.means_lr_final / config.means_lr) ** progress,
        "log_scales": fallen * config.log_scales_lr,
        "quats": fallen * config.quats_lr,
        "logit_opacities": fallen * config.logit_opacities_lr,
        "sh0": fallen * config.sh0_lr,
        "sh_rest": fallen * config.sh_rest_lr,
    }
    return AdamStep(iteration, rates, config.beta1, config.beta2, config.eps, sh_degree, penalties)


class Adam:
    """Adam for your own training loops, with the learning rates of training; all arrays stay on the device.

    Parameters
    ----------
    gaussians : Gaussians
        Gaussians to train, pre-activation. Their arrays are copied to the device, where `step` changes them in place.
    renderer : Renderer
        Renderer that computes the gradients.
    iterations : int
        Number of steps, over which the learning rate of the means falls.
    extent : float
        Scale of the scene, world units; the learning rate of the means is proportional to it.
    config : OptimConfig
    """

    def __init__(
        self,
        gaussians: Gaussians,
        renderer: Renderer,
        iterations: int,
        extent: float = 1.0,
        config: OptimConfig = OptimConfig(),
    ):
        moments = Moments.zeros(fetch(gaussians))
        self.gaussians = renderer.place(gaussians)
        self.iteration = 0
        self._moments = renderer.place(moments.first), renderer.place(moments.second)
        self._renderer, self._iterations, self._extent, self._config = renderer, iterations, extent, config

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics to be rendered next."""
        return sh_degree_at(self.iteration + 1, self._config.sh_degree_every, self.gaussians.sh_degree)

    def step(self, gradients: Gaussians) -> None:
        """Take one step down the gradients with respect to the Gaussians, on the device or the host."""
        degree = self.sh_degree
        self.iteration += 1
        progress = min(1.0, (self.iteration - 1) / max(self._iterations - 1, 1))
        settings = adam_settings(self.iteration, progress, self._extent, self._config, degree)
        gradients = self._renderer.place(gradients)
        self._renderer.stages.adam_step(self.gaussians, gradients, *self._moments, settings)


class Optimizer:
    """Adam on the device, or in NumPy on the host: the same to rounding.

    Attributes
    ----------
    home : Device or None
        Place of parameters, moments and statistics: the device, or None for the host.
    stages : Stages
        The functions of the stages that work there.
    """

    def __init__(self, renderer: Renderer, kind: Literal["device", "numpy"]):
        self._renderer = renderer
        self.home: Device | None = renderer.device if kind == "device" else None
        self.stages: Stages = renderer.stages if kind == "device" else reference

    def bring(self, array: Any) -> Any:
        """A device array where the optimiser works."""
        return download(array) if self.home is None else array

    def place_rows(self, rows: Array) -> Any:
        """Numbers of rows from the host, for `take_rows` of the stages."""
        return rows if self.home is None else self.home.upload("rows", rows, np.int32)

    def step(
        self,
        gaussians: Gaussians,
        moments: Moments,
        smoothing: SmoothingFilter | None,
        run: Pass,
        v_splats: AnyGrads,
        settings: AdamStep,
        *,
        camera_grad: bool = False,
    ) -> CameraGrads | None:
        """Differentiate by the parameters and take one step of Adam on them, in place.

        On the device both are one kernel, unless the 3D filter comes between them.

        Parameters
        ----------
        gaussians, moments
            The parameters and their moments, at `home`.
        smoothing : SmoothingFilter or None
            The 3D filter that was applied before rendering.
        run, v_splats
            The forward pass, and the gradients with respect to its splats.
        settings : AdamStep
        camera_grad : bool
            Whether the gradient with respect to the camera is computed.

        Returns
        -------
        CameraGrads or None
        """
        stages, both = self._renderer.stages, (moments.first, moments.second)
        options = {"antialiased": self._renderer.config.mode == "antialiased", "camera_grad": camera_grad}
        if self.home is not None and smoothing is None:
            return stages.project_bwd_adam(gaussians, both, run.camera, run.splats, v_splats, settings, **options)
        v_gaussians, v_camera = stages.project_bwd(
            run.gaussians, run.camera, settings.sh_degree, run.splats, v_splats, **options
        )
        if smoothing:
            v_gaussians = smoothing.backward(stages, self._renderer.place(gaussians), v_gaussians)
        if self.home is None:
            v_gaussians = fetch(v_gaussians)
        self.stages.adam_step(gaussians, v_gaussians, *both, settings, self.bring(run.splats.extents))
        return v_camera
