"""What flows between the stages: one set of containers for device arrays (`clsplat.ops`) and NumPy
(`clsplat.reference`).

N Gaussians, M intersections of a splat with a tile, T tiles, C colour channels, H x W pixels.
"""

from typing import Any, NamedTuple

ERANK_SLACK = 1e-5
"""Bounds the penalty of needles: at an effective rank of 1 it is 11.5 (Hyung et al. 2024)."""

GATE_SLOPE, GATE_OPACITY = 100.0, 0.005
"""Noise on the means fades out where the opacity rises above 0.005, over some hundredths (original code of Kheradmand
et al. 2024)."""


class Splats(NamedTuple):
    """Projected Gaussians; an invisible one has extents 0 and its other fields 0.

    means2d (N, 2) px; conics (N, 3) px^-2, the entries xx, xy, yy of the inverse 2D covariance; depths (N,) world
    units; extents (N, 2) px, half widths of the box outside which alpha < ALPHA_MIN; opacities (N,) in [0, 1],
    compensation included; colors (N, C), RGB and, for C = 4, the depth.
    """

    means2d: Any
    conics: Any
    depths: Any
    extents: Any
    opacities: Any
    colors: Any


class SplatGrads(NamedTuple):
    """Gradients with respect to the fields of `Splats` that compositing reads, of the same shapes."""

    means2d: Any
    conics: Any
    opacities: Any
    colors: Any


class CameraGrads(NamedTuple):
    """Gradients with respect to a camera.

    viewmat (4, 4): each entry as an independent variable, its last row 0; intrinsics (4,): fx, fy, cx, cy.
    """

    viewmat: Any
    intrinsics: Any


class Dropout(NamedTuple):
    """Which splats are left out of an image: `rate` of them, in [0, 1), drawn anew for each seed and iteration."""

    rate: float
    seed: int
    iteration: int

    @property
    def gain(self) -> float:
        """Factor on the opacity of the others."""
        return 1 / (1 - self.rate)

    @property
    def threshold(self) -> int:
        """Of 32-bit draws: those below it are dropped."""
        return round(self.rate * 2**32)


class Bins(NamedTuple):
    """Lists of splats per tile, in depth order.

    gauss_ids (M,) uint32 and tile_ranges (T, 2) uint32: tile t, row-major, holds gauss_ids[begin:end]. order (N,)
    uint32: the splats in the order of their slots, by depth (ties by index, invisible ones last) or by index;
    first_slots (N + 1,) uint32: splat order[i] owns the slots first_slots[i] to first_slots[i + 1]; slots (M,)
    uint32: the slot of each entry of gauss_ids. Lists that were made without gradients have None for the last two.
    """

    gauss_ids: Any
    tile_ranges: Any
    order: Any
    first_slots: Any
    slots: Any
    tile_size: int
    width: int
    height: int


class Image(NamedTuple):
    """What compositing yields: image (H, W, C), background included, and alpha (H, W)."""

    image: Any
    alpha: Any


class Removal(NamedTuple):
    """What becomes of an image's squared error, summed over pixels and channels, if one splat alone changes.

    errors (N,): by how much it grows if the splat is removed; differences (N,): the squared difference that this
    makes to the image, the same if the image is its own target; weights (N,), squares (N,): sums of the weight
    w = alpha T and of w^2; pulls (N, C): sums of w r with r = image - target. Another colour c + d makes the error
    grow by squares |d|^2 + 2 pulls . d. All are 0 for what is not seen.
    """

    errors: Any
    differences: Any
    weights: Any
    squares: Any
    pulls: Any


class AdamStep(NamedTuple):
    """One step of the optimiser: its number, counted from 1, and its constants.

    rates: learning rate by field of `clsplat.gaussians.Gaussians`, with sh0 and sh_rest in the place of sh.
    sh_degree: bands above it have had no gradient yet, and are left alone. penalties: weights in the loss of the sum
    of all opacities, of that of all scales, and of that of max(-ln(erank - 1 + ERANK_SLACK), 0), whose gradients
    are added to those given; erank is a Gaussian's effective rank: 1 for a needle, 2 for a disc, 3 for a ball.
    """

    iteration: int
    rates: dict[str, float]
    beta1: float
    beta2: float
    eps: float
    sh_degree: int
    penalties: tuple[float, float, float] = (0.0, 0.0, 0.0)
