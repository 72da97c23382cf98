"""Configuration: frozen dataclasses from which the command line, ``config.json`` and the docs table come."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from clsplat.constants import TILE

Mode = Literal["classic", "antialiased"]
Background = Literal["black", "white"]

SHORT_RUN = 7000
"""Iterations of the paper's shorter setting (table 1, "7K"). Its fixed intervals leave 700 iterations without
densification and view dependence: fox_pinhole at 269x480 then reached 23.6 dB instead of 26.6 dB."""

BACKGROUNDS: dict[Background, tuple[float, float, float]] = {
    "black": (0.0, 0.0, 0.0),
    "white": (1.0, 1.0, 1.0),
}


@dataclass(frozen=True)
class RenderConfig:
    """How Gaussians become an image."""

    mode: Mode = "classic"
    """classic: the paper's dilation by 0.3 px^2. antialiased: opacity compensated for it (Mip-Splatting)."""
    tile_size: Literal[8, 16] = TILE
    """Edge of a tile in pixels; changes speed, not the image."""
    compositor: Literal["auto", "cpu", "gpu"] = "auto"
    """Kernel variant of the compositing stage; auto takes the one for the device's type."""
    sort: Literal["auto", "global", "per_tile", "pixel"] = "auto"
    """How splats are brought into the order of their centres' depths: all of them before they are distributed to
    tiles (global), or within each tile afterwards (per_tile). Changes speed, not the image; auto takes global, the
    faster one where measured. pixel sorts anew in each pixel, by where its ray meets the Gaussians: nothing pops when
    the camera turns, but it is slower (StopThePop)."""
    near: float | None = None
    """Depth in world units up to which nothing is drawn; default: for a dataset's cameras a tenth of the depth of its
    nearest points, 0.01 for others. Gaussians that a camera nearly touches, of a wall beside the photographer for
    example, spread over its whole image."""


@dataclass(frozen=True)
class SfmConfig:
    """How poses are recovered from photos (pycolmap: SIFT, matching, incremental mapping)."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """exhaustive: every pair of photos. sequential: neighbours by file name. auto: sequential for the frames that
    clsplat took out of a video, exhaustive otherwise."""
    camera_model: str = "OPENCV"
    """COLMAP camera model that is fitted; photos are undistorted when they are loaded."""
    single_camera: bool = True
    """All photos come from one camera at one zoom; otherwise each photo gets intrinsics of its own."""
    max_image_size: int = 1600
    """Longer edge in pixels at which features are searched."""
    min_registered: int = 3
    """Fewer registered photos than this are an error."""


@dataclass(frozen=True)
class DataConfig:
    """Which photos are read, and how."""

    downscale: Literal[1, 2, 4, 8] = 1
    """Reads images_2, images_4 or images_8 where present; resamples the photos otherwise."""
    test_every: int = 8
    """Every n-th photo by name is held out (0: none); ignored where the dataset brings its own split."""
    background: Background = "black"
    """Behind the scene, and behind transparent photos."""
    random_background: bool = False
    """Train each iteration before another colour: dark areas then stay opaque, which could as well let a black
    background through. Evaluation keeps `background`."""
    masks: str | None = None
    """Folder of masks named as the photos (NAME.png or NAME.jpg.png): white pixels train, black ones do not."""
    invert_masks: bool = False
    """The other way round: black pixels train, white ones do not."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Used where there are photos but no poses."""


@dataclass(frozen=True)
class InitConfig:
    """The Gaussians that training starts from."""

    triangulate: bool = True
    """Where the dataset has poses but no points, find points by its photos; without it the start is random."""
    random_points: int | None = None
    """Gaussians of a random start, where there are no points; default: 100 000 (the original's number), 10 000 with
    --size auto, which adds where they are needed."""
    random_extent: float = 1 / 3
    """Half edge of the random start's box, as a fraction of the cameras' mean distance from the point they look
    at; for NeRF-synthetic scenes (distance 4) that is the original's box within 3 %."""
    opacity: float | None = None
    """Opacity at the start; default: what suits the strategy, 0.1 for adc and 0.5 for the others."""
    sh_degree: Literal[0, 1, 2, 3] = 3
    """Highest degree of the spherical harmonics."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its learning rates (the original's values)."""

    means_lr: float = 1.6e-4
    """At the start, times the scene's extent."""
    means_lr_final: float = 1.6e-6
    """At the last iteration, times the scene's extent; exponential in between."""
    log_scales_lr: float = 5e-3
    quats_lr: float = 1e-3
    logit_opacities_lr: float = 5e-2
    sh0_lr: float = 2.5e-3
    sh_rest_lr: float = 2.5e-3 / 20
    """Spherical harmonics of degree 1 and above."""
    beta1: float = 0.9
    beta2: float = 0.999
    eps: float = 1e-15
    ssim_weight: float = 0.2
    """lambda of the loss (1 - lambda) L1 + lambda (1 - SSIM) (paper, equation 7)."""
    sh_degree_every: int = 1000
    """Iterations after which one more band of spherical harmonics is trained; fewer in short runs."""
    erank_penalty: float = 0.0
    """Weight in the loss of the mean over Gaussians of max(-ln(effective rank - 1), 0): against needles."""
    exposure_lr: float = 1e-2
    """Of the photos' exposures, at the start (that of the original's code)."""
    exposure_lr_final: float = 1e-3
    """At the last iteration; exponential in between."""
    poses_lr: float = 1e-3
    """Of the photos' poses, at the start: radians, and extents of the scene."""
    poses_lr_final: float = 1e-5
    """At the last iteration; exponential in between."""


@dataclass(frozen=True)
class CoarseConfig:
    """Coarse to fine: the first iterations see smaller photos, in less time (Chen et al. 2025, "DashGaussian")."""

    factor: Literal[1, 2, 4, 8] = 1
    """By which the photos' edges are divided at the start; halved at equal intervals. 1: no smaller photos."""
    until: float = 0.5
    """Fraction of the iterations after which the photos have their full size."""


@dataclass(frozen=True)
class AdcConfig:
    """Adaptive density control (paper, section 5.2; the original's values)."""

    start: int = 500
    """First iteration after which Gaussians are added or removed; sooner in short runs."""
    stop_fraction: float = 0.5
    """Fraction of the iterations after which the number of Gaussians stays fixed."""
    every: int = 100
    """Iterations between two rounds."""
    grad_threshold: float = 2e-4
    """Mean norm of the positional gradient, in normalised device coordinates, above which a Gaussian is densified."""
    scale_threshold: float = 0.01
    """Largest scale, in scene extents, up to which it is cloned and beyond which it is split."""
    opacity_min: float = 0.005
    """Gaussians of a lower opacity are removed."""
    scale_max: float = 0.1
    """Gaussians with a larger scale, in scene extents, are removed once opacities have been reset."""
    reset_every: int = 3000
    """Iterations between two resets of the opacities."""
    reset_opacity: float = 0.01
    """Opacities are lowered to at most this value at a reset; it lies above ALPHA_MIN, so that gradients survive."""
    opacity_decay: float = 0.0
    """Where above 0, opacities are not reset: each round takes this fraction of them, and the image does not dip."""
    min_gaussians: int = 16
    """Pruning never leaves fewer, however transparent they are."""


@dataclass(frozen=True)
class McmcConfig:
    """3D Gaussian Splatting as Markov chain Monte Carlo (Kheradmand et al. 2024; the original's values)."""

    start: int = 500
    """First iteration after which Gaussians are relocated or added; sooner in short runs."""
    stop_fraction: float = 0.83
    """Fraction of the iterations after which they no longer are (gsplat: 25 000 of 30 000)."""
    every: int = 100
    """Iterations between two rounds."""
    growth: float = 0.05
    """Gaussians added per round, as a fraction of all; more where the cap would be reached too late otherwise."""
    full_fraction: float = 0.25
    """Fraction of the iterations by which the cap is reached (the original: 5200 of 30 000, for 1 million)."""
    opacity_min: float = 0.005
    """Gaussians of this opacity or a lower one are dead: they are relocated onto live ones."""
    noise_lr: float = 1e7
    """Strength of the noise on the means, in units of their learning rate and per squared extent of the scene (the
    original's 5e5, in world units, at an extent of 4.5)."""
    opacity_penalty: float = 0.01
    """Weight of the mean opacity in the loss."""
    scale_penalty: float = 0.045
    """Weight of the mean scale, in extents of the scene, in the loss (the original's 0.01, in world units, at an
    extent of 4.5)."""


@dataclass(frozen=True)
class ErrorConfig:
    """Growth to a cap where the photos' errors are (sources: clsplat.training.densify.error_guided; values measured:
    docs/howto/strategies.md)."""

    start: int = 500
    """First iteration after which Gaussians are split or removed; sooner in short runs."""
    stop_fraction: float = 0.8
    """Fraction of the iterations after which they no longer are."""
    every: int = 100
    """Iterations between two rounds."""
    growth: float = 0.05
    """Gaussians added per round, as a fraction of all; more where the cap would be reached too late otherwise."""
    full_fraction: float = 0.4
    """Fraction of the iterations by which the cap is reached."""
    views: int = 10
    """Photos rendered per round to see where the errors are."""
    opacity_min: float = 0.005
    """Gaussians of this opacity or a lower one are removed."""
    replaced: float = 0.02
    """Fraction of the Gaussians that make room for others in each round at the cap: those whose removal changes the
    squared error of the photos least."""
    replaced_most: float = 0.05
    """The largest such fraction: all make room, up to it, whose removal would even lower the error."""


@dataclass(frozen=True)
class FewViewsConfig:
    """Training on few photos (clsplat.training.few_views has the reasons, docs/stability.md what each brings)."""

    below: int = 9
    """With fewer training photos than this, the other settings hold (0: never)."""
    dropout: float = 0.2
    """Share of the splats left out of each image at the end (DropGaussian)."""
    sh_degree: Literal[0, 1, 2, 3] = 1
    """Highest degree of the spherical harmonics."""
    growth: float = 2.0
    """The most Gaussians, as a multiple of the scene's points."""


@dataclass(frozen=True)
class TrainConfig:
    """A whole training run; saved as ``config.json``, from which it can be repeated."""

    iterations: int = 7000
    """Optimisation steps. In runs shorter than 7000, the paper's shorter setting, the first densification and new
    bands of spherical harmonics come sooner in proportion."""
    seed: int = 0
    """Of the random start, the order of the photos and all that the strategy draws."""
    optimizer: Literal["device", "numpy"] = "device"
    """Where Adam runs: in a kernel, or in NumPy on the host (slower; the same to rounding)."""
    strategy: str = "error"
    """Densification strategy: a name of clsplat.training.densify.STRATEGIES. adc is the paper's."""
    size: Literal["auto", "fixed"] = "auto"
    """auto: the number of Gaussians and the degree of the spherical harmonics are chosen from the photos, parts of
    which validate in the meantime (size.json explains the choice). fixed: what the strategy makes, up to the cap."""
    size_price: float = 0.05
    """Decibels of PSNR that twice as many Gaussians, or bytes, must gain; with --size auto."""
    max_gaussians: int | None = None
    """Hard cap, under every strategy: in no iteration are there more Gaussians. A start of more is thinned to it.
    mcmc and error grow to it, and need it with --size fixed."""
    dropout: float = 0.0
    """Share of the splats left out of each image at the end; it rises from 0 over the training."""
    exposure: bool = False
    """Learn an affine map of colours for each training photo, for photos of changing exposure or white balance."""
    filter_3d: bool = False
    """No Gaussian gets thinner than the photos resolve (Mip-Splatting's 3D filter): for scenes that will be seen from
    nearer, or at a larger size, than they were photographed; with --mode antialiased also from farther. Saved scenes
    contain it: other viewers need nothing."""
    poses: bool = False
    """Refine the training photos' poses: where they were not made by structure from motion, or badly. Held-out photos
    are then evaluated twice: as posed, and with each camera aligned with the scene."""
    checkpoint_every: int = 1000
    """Iterations between two checkpoints, from which an interrupted run resumes."""
    eval_every: int = 500
    """Iterations between two evaluations on the held-out photos for the training curve (0: none before the end)."""
    device: str | None = None
    """Part of the platform's or device's name; PYOPENCL_CTX is honoured where this is not given."""
    memory_limit: str | None = None
    """Device memory that may be used, such as 4GB or 512MiB (default: all there is). The number of Gaussians stops
    growing where more would exceed it, and photos that do not fit beside them are uploaded anew each time."""
    data: Annotated[DataConfig, tyro.conf.arg(name="")] = field(default_factory=DataConfig)
    init: InitConfig = field(default_factory=InitConfig)
    optim: OptimConfig = field(default_factory=OptimConfig)
    coarse: CoarseConfig = field(default_factory=CoarseConfig)
    adc: AdcConfig = field(default_factory=AdcConfig)
    mcmc: McmcConfig = field(default_factory=McmcConfig)
    error: ErrorConfig = field(default_factory=ErrorConfig)
    few: FewViewsConfig = field(default_factory=FewViewsConfig)
    render: Annotated[RenderConfig, tyro.conf.arg(name="")] = field(default_factory=RenderConfig)

    def shortened(self, interval: int) -> int:
        """An interval of iterations as this run uses it: in proportion where the run is a short one, at least 1."""
        return max(1, round(interval * min(1.0, self.iterations / SHORT_RUN)))
