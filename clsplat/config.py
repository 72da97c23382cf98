"""Configuration: frozen dataclasses from which the command line, ``config.json`` and the docs table come."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import tyro

from clsplat.ranges import byte_size, name_in, within

Mode = Literal["classic", "antialiased"]
Background = Literal["black", "white"]

# Ranges of most fields, which `clsplat.ranges.check` checks.
Count = Annotated[int, within(least=1)]
Fraction = Annotated[float, within(least=0, most=1)]
PositiveFraction = Annotated[float, within(above=0, most=1)]
PartialFraction = Annotated[float, within(least=0, below=1)]
Positive = Annotated[float, within(above=0)]
NonNegative = Annotated[float, within(least=0)]

MOST_DOWNSCALE = 16
"""Largest factor by which photos are reduced: sums of more than 16 x 16 bytes exceed 16 bits."""
Downscale = Annotated[int | Literal["auto"], within(least=1, most=MOST_DOWNSCALE)]

INT32_MAX, UINT32_MAX, UINT64_MAX = 2**31 - 1, 2**32 - 1, 2**64 - 1
"""Largest integers of COLMAP's options, of indices and counters on the device, and of the keys of random numbers."""

SHORT_RUN = 7000
"""Iterations of the paper's shorter setting (table 1, "7K"). In shorter runs its intervals are shortened in
proportion; otherwise a run of 700 iterations would have neither densification nor view dependence."""

BACKGROUNDS: dict[Background, tuple[float, float, float]] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass(frozen=True)
class RenderConfig:
    """Settings of rendering."""

    mode: Mode = "classic"
    """classic: the paper's dilation by 0.3 px^2. antialiased: the opacity is compensated for it (Mip-Splatting)."""
    tile_size: Literal["auto", 8, 16, 32] = "auto"
    """Edge of a tile, px. It changes the speed, not the image. auto: 8 on GPUs, 32 on CPUs with vectors of 16 numbers
    (AVX-512), otherwise 16."""
    compositor: Literal["auto", "cpu", "gpu"] = "auto"
    """Kernel variant of the compositing stage; auto chooses by the type of the device."""
    sort: Literal["auto", "global", "per_tile", "pixel"] = "auto"
    """Order of the splats. global and per_tile: by the depths of their centres, sorted before the splats are
    distributed to tiles or within each tile afterwards; both give the same image. auto: global. pixel: in each pixel
    by the points where its ray meets the Gaussians (StopThePop). Nothing then pops when the camera turns, but
    rendering is slower."""
    projection: Literal["affine", "ray"] = "affine"
    """affine: the paper's local affine approximation of the camera. Its error grows with the angle from the axis and
    with the size of a Gaussian. ray: exact along the ray of each pixel, for wide angles, fisheyes and panoramas."""
    near: Annotated[float | None, within(above=0)] = None
    """Depth up to which nothing is drawn, world units. Default: for a dataset's cameras, three tenths of the depth of
    the nearest points in each photo; for others, by the size of the scene. Gaussians very close to a camera would
    otherwise spread over its whole image."""


@dataclass(frozen=True)
class SfmConfig:
    """Settings of structure from motion (pycolmap: SIFT, matching, mapping)."""

    matching: Literal["auto", "exhaustive", "sequential", "gps", "vocabulary"] = "auto"
    """Pairs of photos that are matched. exhaustive: all. sequential: neighbours by file name. gps: neighbours by the
    positions in the photos' EXIF data. vocabulary: those that look alike. auto: sequential for frames that clsplat
    extracted from a video, exhaustive otherwise."""
    vocabulary: Annotated[str | None, tyro.conf.arg(metavar="FILE")] = None
    """COLMAP's vocabulary tree for SIFT, for matching by vocabulary."""
    mapper: Literal["auto", "incremental", "global"] = "auto"
    """Method that finds the poses. incremental: photos are added one after the other. global: all poses are found at
    once (GLOMAP). auto: global for 100 photos or more."""
    camera_model: Annotated[str, name_in("clsplat.dataset.lenses:camera_models")] = "OPENCV"
    """COLMAP camera model to fit; photos are undistorted when they are loaded."""
    single_camera: bool = True
    """Treat all photos as taken by one camera with one focal length; otherwise each photo has its own intrinsics."""
    max_image_size: Annotated[int, within(least=1, most=INT32_MAX)] = 1600
    """Longer edge of the photos in which features are detected, px."""
    min_registered: Annotated[int, within(least=2, most=INT32_MAX)] = 3
    """Fewest photos for which a pose must be found; fewer are an error."""


@dataclass(frozen=True)
class DataConfig:
    """Settings of loading a dataset."""

    downscale: Downscale = "auto"
    """Divisor of the photos' edges (images_2 etc. are read if they exist). auto: the smallest for at most 1920 x 1080
    pixels."""
    test_every: Annotated[int, within(least=0)] = 8
    """Every n-th photo by name is held out (0: none). Ignored if the dataset has its own split."""
    background: Background = "black"
    """Colour behind the scene and behind transparent photos."""
    random_background: bool = False
    """Train each iteration with another background colour. Dark areas then become opaque instead of transparent in
    front of a black background. Evaluation uses `background`."""
    panoramas: Literal["faces", "whole"] = "faces"
    """faces: each equirectangular photo becomes six pinhole photos, the faces of a cube. whole: it stays as it is,
    which needs `--projection ray`; pixels at the poles then have the same weight as those at the horizon."""
    masks: Annotated[str | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of masks, named as the photos are (NAME.png or NAME.jpg.png): white pixels train, black ones do not."""
    invert_masks: bool = False
    """Invert the masks: black pixels train, white ones do not."""
    depth: Annotated[str | None, tyro.conf.arg(metavar="FOLDER")] = None
    """Folder of depth maps, named as the photos are (NAME.png of 16 bits, NAME.npy or NAME.tiff). They hold depths or
    inverse depths in any unit, which are scaled to the scene's points; 0 is unknown. For few photos."""
    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Settings of structure from motion, which recovers the cameras of photos without poses."""


@dataclass(frozen=True)
class InitConfig:
    """Settings of the first Gaussians."""

    triangulate: bool = True
    """Triangulate points from the photos if the dataset has poses but no points; otherwise the start is random."""
    dense: bool = True
    """Add points where neighbouring photos agree on a depth, if there are few sparse points for the photos' size."""
    sky: bool = True
    """Start with distant Gaussians of the sky, where photos show a smooth region above or all around the scene."""
    random_points: Annotated[int | None, within(least=1, most=UINT32_MAX)] = None
    """Number of Gaussians of a random start, if there are no points. Default: 100 000 (original), or 10 000 with
    --size auto, which adds more where they are needed."""
    random_extent: Positive = 1 / 3
    """Half edge of the box of a random start, as a fraction of the cameras' mean distance from the point they look
    at. For NeRF-synthetic scenes (distance 4) the box is that of the original within 3 %."""
    opacity: Annotated[float | None, within(above=0, below=1)] = None
    """Opacity of the first Gaussians. Default: that of the strategy, which is 0.1 for adc and error, 0.5 for mcmc."""
    sh_degree: Literal[0, 1, 2, 3] = 3
    """Highest degree of the spherical harmonics."""


@dataclass(frozen=True)
class OptimConfig:
    """Adam and its learning rates: six times the original's, that of the opacities three times, for runs of fewer
    iterations. The presets have the original's."""

    means_lr: Positive = 9.6e-4
    """Learning rate of the means at the start, in extents of the scene."""
    means_lr_final: Positive = 9.6e-6
    """Learning rate of the means at the last iteration; it changes exponentially in between."""
    log_scales_lr: NonNegative = 3e-2
    """Learning rate of the logarithms of the scales."""
    quats_lr: NonNegative = 6e-3
    """Learning rate of the quaternions."""
    logit_opacities_lr: NonNegative = 0.15
    """Learning rate of the logits of the opacities."""
    sh0_lr: NonNegative = 1.5e-2
    """Learning rate of the spherical harmonics of degree 0."""
    sh_rest_lr: NonNegative = 1.5e-2 / 20
    """Learning rate of the spherical harmonics of degree 1 and above."""
    rates_final: PositiveFraction = 0.1
    """Factor on the learning rates above, except that of the means, at the last iteration. It falls exponentially
    from 1 over the last two fifths of the iterations."""
    beta1: PartialFraction = 0.9
    """Decay rate of Adam's mean of the gradients."""
    beta2: PartialFraction = 0.99
    """Decay rate of Adam's mean of the squared gradients; lower than the original's 0.999, as gradients are rare."""
    eps: Positive = 1e-15
    """Term that Adam adds to the root of the mean square."""
    ssim_weight: Fraction = 0.2
    """Weight lambda in the loss (1 - lambda) L1 + lambda (1 - SSIM) (paper, equation 7)."""
    sh_degree_every: Count = 700
    """Iterations after which the degree of the trained spherical harmonics rises by one; fewer in short runs."""
    erank_penalty: NonNegative = 0.0
    """Weight in the loss of the penalty of needles: the mean over Gaussians of max(-ln(effective rank - 1), 0)."""
    depth_weight: Positive = 1.0
    """Weight in the loss, at the start, of the relative difference from the depth maps; with --depth."""
    depth_weight_final: Positive = 0.1
    """Weight of the depth maps at the last iteration; it changes exponentially in between."""
    exposure_lr: Positive = 1e-2
    """Learning rate of the photos' exposures at the start (original code); for gains it is ten times as high."""
    exposure_lr_final: Positive = 1e-3
    """Learning rate of the exposures at the last iteration; it changes exponentially in between."""
    poses_lr: Positive = 1e-3
    """Learning rate of the photos' poses at the start: in radians, and in extents of the scene."""
    poses_lr_final: Positive = 1e-5
    """Learning rate of the poses at the last iteration; it changes exponentially in between."""


@dataclass(frozen=True)
class CoarseConfig:
    """Coarse to fine: the first iterations train on smaller photos (Chen et al. 2025, "DashGaussian")."""

    factor: Literal[0, 1, 2, 4, 8] = 0
    """Divisor of the photos' edges at the start, halved at equal intervals. 0: 4 with --size auto and photos of more
    than 90 000 pixels, otherwise 1."""
    until: Fraction = 0.3
    """Fraction of the iterations after which photos have their full size."""


@dataclass(frozen=True)
class AdcConfig:
    """Adaptive density control (paper, section 5.2; the original's values)."""

    start: Annotated[int, within(least=0)] = 500
    """First iteration after which Gaussians are added or removed; earlier in short runs."""
    stop_fraction: Fraction = 0.5
    """Fraction of the iterations after which the number of Gaussians is fixed."""
    every: Count = 100
    """Iterations between two rounds."""
    grad_threshold: NonNegative = 2e-4
    """Mean positional gradient, in normalised device coordinates, from which Gaussians are cloned or split."""
    scale_threshold: NonNegative = 0.01
    """Scale of the longest axis, in extents of the scene, up to which Gaussians are cloned; larger ones are split."""
    opacity_min: PartialFraction = 0.005
    """Opacity below which Gaussians are removed."""
    scale_max: NonNegative = 0.1
    """Scale, in extents of the scene, above which Gaussians are removed once opacities have been reset."""
    reset_every: Count = 3000
    """Iterations between two resets of the opacities."""
    reset_opacity: Annotated[float, within(above=0, below=1)] = 0.01
    """Largest opacity after a reset; above ALPHA_MIN, so that gradients do not vanish."""
    opacity_decay: PartialFraction = 0.0
    """Fraction by which each round lowers the opacities. Above 0 it replaces the resets, which disturb the image."""
    min_gaussians: Count = 16
    """Fewest Gaussians that pruning leaves."""


@dataclass(frozen=True)
class McmcConfig:
    """3D Gaussian Splatting as Markov chain Monte Carlo (Kheradmand et al. 2024; the original's values)."""

    start: Annotated[int, within(least=0)] = 500
    """First iteration after which Gaussians are relocated or added; earlier in short runs."""
    stop_fraction: Fraction = 0.83
    """Fraction of the iterations after which Gaussians are no longer relocated or added (gsplat: five sixths)."""
    every: Count = 100
    """Iterations between two rounds; fewer with --size auto in runs shorter than 3000, in proportion."""
    growth: NonNegative = 0.05
    """Gaussians added per round, as a fraction of all; more if the cap would otherwise be reached too late."""
    full_fraction: Fraction = 0.25
    """Fraction of the iterations by which the cap is reached (original: 5200 of 30 000, for 1 million)."""
    opacity_min: PartialFraction = 0.005
    """Opacity up to which a Gaussian is dead and is relocated to a live one."""
    noise_lr: NonNegative = 1e7
    """Strength of the noise on the means, in units of their learning rate and per squared extent of the scene
    (original: 5e5 in world units, at an extent of 4.5)."""
    opacity_penalty: NonNegative = 0.01
    """Weight of the mean opacity in the loss."""
    scale_penalty: NonNegative = 0.045
    """Weight of the mean scale, in extents of the scene, in the loss (original: 0.01 in world units, extent 4.5)."""


@dataclass(frozen=True)
class ErrorConfig:
    """Growth to a cap in the places of the photos' errors (sources: clsplat.training.densify.error_guided; values
    measured: docs/experiments/strategies.md)."""

    start: Annotated[int, within(least=0)] = 500
    """First iteration after which Gaussians are split or removed; earlier in short runs."""
    stop_fraction: Fraction = 0.8
    """Fraction of the iterations after which Gaussians are no longer split or removed."""
    every: Annotated[int, within(least=0)] = 0
    """Iterations between two rounds (0: a twentieth of all until the cap is reached, and a tenth afterwards)."""
    growth: NonNegative = 0.05
    """Gaussians added per round, as a fraction of all; more if the cap would otherwise be reached too late."""
    full_fraction: Fraction = 0.4
    """Fraction of the iterations by which the cap is reached."""
    views: Count = 10
    """Photos rendered per round to locate the errors, or a tenth of them if this is more."""
    opacity_min: PartialFraction = 0.005
    """Opacity up to which Gaussians are removed."""
    replaced: Fraction = 0.02
    """Fraction of the Gaussians that is replaced in each round at the cap: those whose removal increases the squared
    error of the photos least."""
    replaced_most: Fraction = 0.05
    """Largest fraction of the Gaussians that is replaced in a round, if their removal lowers the error."""
    opacity_penalty: NonNegative = 0.01
    """Weight in the loss of the opacities that a photo shows: their sum, divided by the number of all Gaussians. It
    removes faint Gaussians that no photo needs, which would be a haze in other views."""


@dataclass(frozen=True)
class FewViewsConfig:
    """Settings for few photos (reasons: clsplat.training.few_views; effects: docs/experiments/strategies.md)."""

    below: Annotated[int, within(least=0)] = 17
    """Number of training photos below which all settings for few photos apply (0: none). Up to 23, some do."""
    dropout: PartialFraction = 0.2
    """Fraction of splats left out of each image at the end (DropGaussian); half of it with more photos, up to 23."""
    growth: Positive = 8.0
    """Largest number of Gaussians, as a multiple of the number of the scene's points. Photos of fewer pixels than
    this lower it to their number, at most by half; photos of more than 90 000 pixels may raise it."""


@dataclass(frozen=True)
class TrainConfig:
    """Settings of a training; saved as ``config.json``, from which it can be repeated."""

    iterations: Annotated[int, within(least=0, most=UINT32_MAX)] = 0
    """Optimisation steps; 0: chosen by the photos. The choice is 30 for each training photo, at most 30 000 and at
    least 3000, or 1500 with few photos; more with photos over 90 000 pixels, by the root of their edges. In runs of
    fewer than 7000, the first densification and the bands of spherical harmonics come earlier."""
    seed: Annotated[int, within(least=0, most=UINT64_MAX)] = 0
    """Seed of the random start, of the order of the photos and of the strategy's random numbers."""
    optimizer: Literal["device", "numpy"] = "device"
    """Adam in a kernel on the device, or in NumPy on the host (slower, the same to rounding)."""
    strategy: Annotated[str, name_in("clsplat.training.densify:STRATEGIES")] = "error"
    """Densification strategy; adc is the paper's."""
    size: Literal["auto", "fixed"] = "auto"
    """auto: the number of Gaussians and the degree of the spherical harmonics are chosen from photos that are held
    back until then, and train afterwards (size.json). fixed: the strategy alone decides, up to the cap."""
    size_price: NonNegative = 0.05
    """Gain of quality, dB, that a doubling of the Gaussians or of the bytes must bring; with --size auto. Quality is
    the mean of PSNR and of SSIM in decibels. With half the default, growth may reach twice as many."""
    max_gaussians: Annotated[int | None, within(least=1, most=UINT32_MAX)] = None
    """Largest number of Gaussians in any iteration. A larger start is reduced to it. The strategies mcmc and error
    grow to it and need it with --size fixed."""
    blocks: Annotated[int | Literal["auto"], within(least=1)] = 1
    """Number of blocks in which the scene trains; auto: the fewest that fit the memory limit. Without --scheduler
    they train one after the other, or on all devices of the same name. --iterations counts those of a block."""
    dropout: PartialFraction = 0.0
    """Fraction of the splats left out of each image at the end of the training; it rises from 0."""
    exposure: bool = False
    """Learn an affine map of each training photo's colours, for photos of different exposure or white balance."""
    even_brightness: bool = True
    """Even out the brightness of training photos that differ from those taken next to them; not with --exposure."""
    mask_moving: bool = True
    """Leave out pixels of training photos that the other photos contradict, such as people who walk by."""
    response: bool = False
    """With --exposure, also learn a curve of contrast for each photo, and the dark corners that all photos share."""
    filter_3d: bool = False
    """Keep every Gaussian at least as thick as the photos resolve (Mip-Splatting's 3D filter), for views from closer
    or at a larger size than photos, and with --mode antialiased also from farther away. Saved scenes contain it."""
    poses: bool = False
    """Refine the training photos' poses, if they are inaccurate. Held-out photos are then evaluated twice: with their
    given poses, and with each camera aligned with the scene."""
    checkpoint_every: Count = 1000
    """Iterations between two checkpoints, from which an interrupted run resumes."""
    eval_every: Annotated[int, within(least=0)] = 500
    """Iterations between two evaluations of the held-out photos for the training curve (0: none before the end)."""
    device: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Part of the platform's or device's name. Default: PYOPENCL_CTX, or the first GPU, accelerator or CPU."""
    memory_limit: Annotated[str | None, byte_size()] = None
    """Limit of device memory, such as 4GB or 512MiB (default: all). Near it, Gaussians stop growing and photos are
    not kept there. It also limits the memory for photos (default: half of the machine's); others stay on disk."""
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
        """Shorten an interval of iterations in proportion in a run of fewer than `SHORT_RUN`; at least 1."""
        return max(1, round(interval * min(1.0, self.iterations / SHORT_RUN)))
