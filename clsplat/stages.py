"""The stages of the pipeline: the functions of each, and the containers of arrays that flow between them.

`clsplat.ops` implements `Stages` with kernels on device arrays, `clsplat.reference` in NumPy; both use the same
containers. N Gaussians, M intersections of a splat with a tile, T tiles, C colour channels, H x W pixels.
"""

from collections.abc import Iterable
from math import inf
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, SupportsFloat

from clsplat.field_stages import FieldStages

if TYPE_CHECKING:
    from clsplat.camera import Camera
    from clsplat.gaussians import Gaussians

Array = Any
"""An array of the device, or of NumPy."""

ERANK_SLACK = 1e-5
"""Offset of the effective rank in the penalty of needles, which bounds it by 11.5 (Hyung et al. 2024)."""

GATE_SLOPE, GATE_OPACITY = 100.0, 0.005
"""Slope and centre of the sigmoid of the opacity that fades out the noise on the means (original code of Kheradmand
et al. 2024)."""


class Splats(NamedTuple):
    """Projected Gaussians; an invisible one has extents 0 and its other fields 0.

    means2d (N, 2) px; conics (N, 3) px^-2, the entries xx, xy, yy of the inverse 2D covariance; depths (N,) world
    units; extents (N, 2) px, half widths of the box outside which alpha < ALPHA_MIN; opacities (N,) in [0, 1],
    compensation included; colors (N, C), RGB and, for C = 4, the depth, or after `disparity_fwd` its inverse.
    """

    means2d: Any
    conics: Any
    depths: Any
    extents: Any
    opacities: Any
    colors: Any


class RaySplats(NamedTuple):
    """Gaussians projected for evaluation along rays; the first six fields are those of `Splats`.

    means2d, conics and extents are the outline, outside of which alpha < ALPHA_MIN: an ellipse, or where the conic is
    0 the box of the extents. rays (N, 8 or 17): the terms of the exponent (cl/gaussian_rays.h), which are the centre
    in a chart, Q (xx, xy, yy), the slopes of lambda and k; 17 with the axes of a chart of its own. directions
    (H, W, 3): unit vectors of the pixels' rays in the camera's frame, for such charts; otherwise (1, 1, 3) zeros.
    """

    means2d: Any
    conics: Any
    depths: Any
    extents: Any
    opacities: Any
    colors: Any
    rays: Any
    directions: Any


class SplatGrads(NamedTuple):
    """Gradients with respect to the fields of `Splats` that compositing reads, of the same shapes."""

    means2d: Any
    conics: Any
    opacities: Any
    colors: Any


class RayGrads(NamedTuple):
    """Gradients with respect to what compositing reads of `RaySplats`.

    means2d (N, 2): by the centre in the chart, px^-1; conics (N, 3) and slopes (N, 3): by Q, and by the slopes and k;
    opacities and colors as in `SplatGrads`.
    """

    means2d: Any
    conics: Any
    slopes: Any
    opacities: Any
    colors: Any


AnySplats = Splats | RaySplats
"""Projected Gaussians of either projection."""

AnyGrads = SplatGrads | RayGrads
"""Gradients with respect to them."""


class CameraGrads(NamedTuple):
    """Gradients with respect to a camera.

    viewmat (4, 4): each entry as an independent variable, its last row 0; intrinsics (4,): fx, fy, cx, cy.
    """

    viewmat: Any
    intrinsics: Any


class Dropout(NamedTuple):
    """The splats left out of an image: a fraction `rate` of them, in [0, 1), drawn for each seed and iteration.

    Those beyond the depth `far`, in world units, stay as they are.
    """

    rate: float
    seed: int
    iteration: int
    far: float = inf

    @property
    def gain(self) -> float:
        """Factor on the opacity of the others."""
        return 1 / (1 - self.rate)

    @property
    def threshold(self) -> int:
        """Bound on 32-bit draws, below which a splat is dropped."""
        return round(self.rate * 2**32)


class Bins(NamedTuple):
    """Lists of splats per tile, in depth order.

    gauss_ids (M,) uint32 and tile_ranges (T, 2) uint32: tile t, row-major, holds gauss_ids[begin:end], and tile t + 1
    begins where it ends. first_slots (N + 1,) uint32: splat i owns the slots first_slots[i] to first_slots[i + 1].
    slots (M,) uint32: the slot of each entry of gauss_ids. Lists that were made without gradients have None for the
    last two.
    """

    gauss_ids: Any
    tile_ranges: Any
    first_slots: Any
    slots: Any
    tile_size: int
    width: int
    height: int


class Image(NamedTuple):
    """Result of compositing: rgb (H, W, C), background included, with the depth, or its inverse, as a fourth channel
    if one was requested; and alpha (H, W)."""

    rgb: Any
    alpha: Any


class Removal(NamedTuple):
    """Changes of an image's squared error, summed over pixels and channels, if one splat alone changes.

    errors (N,): by how much it grows if the splat is removed; differences (N,): the squared difference that this
    makes to the image, the same if the image is its own target; weights (N,), squares (N,): sums of the weight
    w = alpha T and of w^2; shares (N,): sums of w |r|^2 with r = image - target; pairs (N,): pixels in which the
    splat is composited; pulls (N, C): sums of w r. Another colour c + d makes the error grow by
    squares |d|^2 + 2 pulls . d. All are 0 for what is not seen.
    """

    errors: Any
    differences: Any
    weights: Any
    squares: Any
    shares: Any
    pairs: Any
    pulls: Any

    @classmethod
    def of(cls, sums: Any) -> "Removal":
        """The fields from their columns in (N, 6 + C) on the host, as `Stages.removal_sums` returns them."""
        errors, differences, weights, squares, shares, pairs = sums.T[:6]
        return cls(errors, differences, weights, squares, shares, pairs, sums[:, 6:])


class AdamStep(NamedTuple):
    """One step of the optimiser: its number, counted from 1, and its constants.

    rates: learning rate by field of `clsplat.gaussians.Gaussians`, with sh0 and sh_rest instead of sh. sh_degree: the
    bands above it have had no gradient yet and do not change. penalties: weights in the loss of the sums of the
    opacities, of the scales, and of max(-ln(erank - 1 + ERANK_SLACK), 0), over the Gaussians that the photo shows,
    whose gradients are added to those given; erank is a Gaussian's effective rank: 1 for a needle, 2 for a disc, 3
    for a ball.
    """

    iteration: int
    rates: dict[str, float]
    beta1: float
    beta2: float
    eps: float
    sh_degree: int
    penalties: tuple[float, float, float] = (0.0, 0.0, 0.0)


class Stages(FieldStages, Protocol):
    """The functions of all stages, on a device (`clsplat.ops.Launches`) or in NumPy (the module `clsplat.reference`).

    This is the only list of their names. Each function's docstring is with its launch in `clsplat.ops`.
    """

    def project_fwd(
        self,
        gaussians: "Gaussians",
        camera: "Camera",
        sh_degree: int,
        *,
        antialiased: bool = False,
        channels: int = 3,
        rays: bool = False,
        gain: float = 1.0,
    ) -> AnySplats: ...
    def join_rows(self, first: Array, second: Array) -> Array: ...
    def project_disparities(self, gaussians: "Gaussians", camera: "Camera", splats: AnySplats) -> Array: ...
    def project_bwd(
        self,
        gaussians: "Gaussians",
        camera: "Camera",
        sh_degree: int,
        splats: AnySplats,
        v_splats: AnyGrads,
        *,
        antialiased: bool = False,
        camera_grad: bool = False,
    ) -> tuple["Gaussians", CameraGrads | None]: ...
    def project_bwd_adam(
        self,
        gaussians: "Gaussians",
        moments: tuple["Gaussians", "Gaussians"],
        camera: "Camera",
        splats: AnySplats,
        v_splats: AnyGrads,
        step: AdamStep,
        *,
        antialiased: bool = False,
        camera_grad: bool = False,
    ) -> CameraGrads | None: ...
    def disparity_fwd(self, splats: AnySplats) -> None: ...
    def disparity_bwd(self, splats: AnySplats, v_splats: AnyGrads) -> None: ...
    def dropout_fwd(self, splats: AnySplats, dropout: Dropout) -> None: ...
    def dropout_bwd(self, splats: AnySplats, v_splats: AnyGrads, dropout: Dropout) -> None: ...
    def bin_splats(
        self,
        splats: AnySplats,
        width: int,
        height: int,
        tile_size: int,
        *,
        gradients: bool = True,
        scheme: str = "auto",
    ) -> Bins: ...
    def composite_fwd(
        self,
        splats: AnySplats,
        bins: Bins,
        background: Any,
        *,
        compositor: str = "auto",
        disparities: Array = None,
    ) -> Image: ...
    def composite_bwd(
        self,
        splats: AnySplats,
        bins: Bins,
        image: Image,
        v_image: Image,
        *,
        compositor: str = "auto",
        disparities: Array = None,
    ) -> AnyGrads: ...
    def absgrad(self, splats: AnySplats, bins: Bins, image: Image, v_image: Image) -> Array: ...
    def count_pairs(self, splats: AnySplats, bins: Bins) -> tuple[Array, Array]: ...
    def median_splats(self, splats: AnySplats, bins: Bins) -> Array: ...
    def removal(
        self, splats: AnySplats, bins: Bins, background: Any, residuals: Any = None, mask: Any = None
    ) -> Removal: ...
    def removal_sums(
        self, splats: AnySplats, bins: Bins, background: Any, residuals: Any = None, mask: Any = None
    ) -> Array: ...
    def removal_residuals(self, image: Array, photo: Array, *, clamped: bool = False) -> Array: ...
    def disparity_loss(self, image: Array, target: Array, weight: float) -> tuple[float, Array]: ...
    def disparity_grad(self, image: Array, target: Array, weight: float, v_rgb: Array) -> Array: ...
    def sweep_scores(self, photo: Array, sources: list[Array], maps: Array, planes: Array) -> Array: ...
    def sweep_best(self, scores: Array, planes: Array) -> tuple[Array, Array]: ...
    def exposure_fwd(self, image: Array, affine: Any, photo: Array) -> Array: ...
    def exposure_bwd(self, image: Array, affine: Any, photo: Array, v_image: Array) -> Any: ...
    def l1_ssim(
        self, image: Array, photo: Array, ssim_weight: float, mask: Array = None
    ) -> tuple[SupportsFloat, Array]: ...
    def observe(
        self, extents: Array, v_means2d: Array, width: int, height: int, grad_sum: Array, seen: Array
    ) -> None: ...
    def add_column(self, values: Array, column: int, sums: Array, factor: float = 1.0) -> None: ...
    def adam_step(
        self,
        gaussians: "Gaussians",
        gradients: "Gaussians",
        first: "Gaussians",
        second: "Gaussians",
        step: AdamStep,
        extents: Array = None,
    ) -> None: ...
    def adam_array(
        self,
        parameters: Array,
        gradients: Array,
        first: Array,
        second: Array,
        rate: float,
        step: AdamStep,
        *,
        sparse: bool = False,
    ) -> None: ...
    def add_noise(self, gaussians: "Gaussians", size: float, seed: int, iteration: int) -> None: ...
    def take_rows(self, array: Array, rows: Array) -> Array: ...
    def count_not_finite(self, values: Array) -> int: ...
    def pixel_sizes(self, gaussians: "Gaussians", cameras: Iterable["Camera"]) -> Array: ...
    def filter_fwd(self, gaussians: "Gaussians", pixels: Array) -> "Gaussians": ...
    def filter_bwd(self, gaussians: "Gaussians", pixels: Array, v: "Gaussians") -> "Gaussians": ...
    def exclusive_scan(self, values: Array, what: str = "scan") -> tuple[Array, int]: ...
    def argsort(
        self, keys: Array, bits: int, method: str = "auto", *, values: Array = None
    ) -> tuple[Array, Array]: ...
    def argsort_segments(self, keys: Array, bits: int, ranges: Array, values: Array = None) -> Array: ...


FUNCTIONS: tuple[str, ...] = tuple(
    name for part in (Stages, FieldStages) for name in vars(part) if not name.startswith("_")
)
"""Names of the functions of `Stages`, in the order of the pipeline."""
