"""The stages of radiance fields: their functions, and the containers of arrays that flow between them.

They belong to `clsplat.stages.Stages`. R rays, S samples, L levels.
"""

from itertools import accumulate, combinations_with_replacement, product
from math import dist, hypot
from typing import Any, NamedTuple, Protocol

Array = Any
"""An array of the device, or of NumPy."""

EXPONENT_MAX = 15.0
"""Largest exponent of a field's density, which is exp of a network's result (code of Müller et al. 2022)."""


NO_ROW = 0xFFFFFFFF
"""Mark of a corner of a sparse grid that has no row in its table."""

TV_EPS = 1e-9
"""Constant under the root of the total variation, which keeps its gradient finite (code of Fridovich-Keil et al.
2022)."""


DENSITY_SHIFT = 1.0
"""Subtracted from a network's result, of which the softplus is a density (Barron et al. 2021, appendix)."""

CHUNK_WIDTH = 16
"""Widths of the layers of networks are multiples of it."""


def encoded_width(levels: int) -> int:
    """Width of an encoding with this number of frequencies: 3 + 6 levels + 1, up to a multiple of 16."""
    return -(-(4 + 6 * levels) // CHUNK_WIDTH) * CHUNK_WIDTH


def _icosahedron_axes() -> tuple[tuple[float, float, float], ...]:
    """Directions of the vertices of an icosahedron and of the middles of its edges, one of each opposite pair."""
    golden, found = (1 + 5**0.5) / 2, []
    corners: list[tuple[float, ...]] = [(0.0, a, b * golden) for a, b in product((-1, 1), repeat=2)]
    corners = [c[k:] + c[:k] for c in corners for k in range(3)]
    # Corners of one edge are 2 apart; the middle of two equal corners is the corner.
    for a, b in combinations_with_replacement(corners, 2):
        if dist(a, b) < 2.1:
            middle = (a[0] + b[0], a[1] + b[1], a[2] + b[2])
            if next(x for x in middle if abs(x) > 1e-9) > 0:
                length = hypot(*middle)
                found.append((middle[0] / length, middle[1] / length, middle[2] / length))
    return tuple(sorted(found))


FRUSTUM_AXES = _icosahedron_axes()
"""Axes (21, 3) on which the encoding of frustums projects them (Barron et al. 2022, supplement)."""

INTERLEVEL_EPS = 1e-7
"""Constant in the denominator of the interlevel loss: rounding of float32 (code of Barron et al. 2022)."""


def frustum_width(levels: int) -> int:
    """Width of an encoding of frustums: a sine and a cosine of each axis and frequency, and 1, up to a multiple of
    16."""
    return -(-(2 * len(FRUSTUM_AXES) * levels + 1) // CHUNK_WIDTH) * CHUNK_WIDTH


class RayColors(NamedTuple):
    """Result of compositing samples along R rays.

    rgb (R, 3), background included; transmittances (S,): light that reaches each sample, 0 behind the end of its ray;
    behind (R,): light that reaches the background.
    """

    rgb: Any
    transmittances: Any
    behind: Any


class Marching(NamedTuple):
    """Sampling of rays: every max(step, cone t) from t = near to t = far, lengths in the field's coordinates.

    Without `contracted`, rays begin and end at the unit cube. With `contracted`, space is contracted to a ball of
    radius 2, and steps beyond t = 1 are equal in contracted lengths: max(step, cone t^2).
    """

    step: float
    cone: float
    near: float
    far: float
    contracted: bool


class Span(NamedTuple):
    """Range of the intervals of rays: lengths in the field's coordinates, as for `Marching`.

    Without `contracted`, rays begin and end at the unit cube, and intervals have equal lengths. With `contracted`,
    rays go from `near` to `far`, and intervals are equal in contracted distances.
    """

    near: float
    far: float
    contracted: bool


class Samples(NamedTuple):
    """Samples of R rays, S in all.

    positions (S, 3) in the unit cube; deltas (S,), lengths that they stand for, of the contracted ray if space is
    contracted; rays_of (S,) uint32; first (R + 1,) uint32: ray r has the samples first[r] to first[r + 1], front to
    back; total: S. Where that is 0, arrays of the device have one entry, of no length, which belongs to no ray.
    """

    positions: Any
    deltas: Any
    rays_of: Any
    first: Any
    total: int


class HashLevels(NamedTuple):
    """Levels of a hash grid, from coarse to fine.

    resolutions: cells along an edge of each level; offsets: first entry of each level in the table, and the number of
    all entries at the end. A level has an entry for each corner of its cells, unless that exceeds the largest size.
    """

    resolutions: tuple[int, ...]
    offsets: tuple[int, ...]

    @classmethod
    def geometric(cls, count: int, coarsest: int, finest: int, entries: int) -> "HashLevels":
        """Make `count` levels whose resolutions are a geometric sequence, of at most `entries` entries each (Müller
        et al. 2022, equations 2 and 3)."""
        growth = (finest / coarsest) ** (1 / max(count - 1, 1))
        resolutions = tuple(round(coarsest * growth**level) for level in range(count))
        sizes = (min((resolution + 1) ** 3, entries) for resolution in resolutions)
        return cls(resolutions, tuple(accumulate(sizes, initial=0)))


class FieldStages(Protocol):
    """The functions of the stages of fields. Each function's docstring is with its launch in `clsplat.ops`."""

    def march(
        self, origins: Array, directions: Array, offsets: Array, occupied: Array, marching: Marching
    ) -> Samples: ...
    def spheres(self, origins: Array, directions: Array, offsets: Array, occupied: Array, near: float) -> Samples: ...
    def hashgrid_fwd(self, positions: Array, table: Array, levels: HashLevels) -> Array: ...
    def hashgrid_bwd(self, positions: Array, v_features: Array, levels: HashLevels) -> Array: ...
    def mlp_fwd(self, inputs: Array, weights: Array, widths: tuple[int, ...]) -> tuple[Array, Array]: ...
    def mlp_bwd(
        self,
        inputs: Array,
        weights: Array,
        widths: tuple[int, ...],
        hidden: Array,
        v_outputs: Array,
        columns: int,
        v_weights: Array | None = None,
    ) -> tuple[Array, Array]: ...
    def voxels_fwd(self, positions: Array, index: Array, table: Array) -> Array: ...
    def voxels_bwd(self, positions: Array, index: Array, rows: int, v_features: Array) -> Array: ...
    def voxels_tv(
        self,
        index: Array,
        corners: Array,
        table: Array,
        v_table: Array,
        weights: tuple[float, float],
        first: int,
        count: int,
    ) -> None: ...
    def heads_join(self, features: Array, directions: Array, rays_of: Array) -> Array: ...
    def heads_join_bwd(self, v_inputs: Array, features: Array, sigmas: Array, v_sigmas: Array) -> Array: ...
    def heads_fwd(self, features: Array, outputs: Array) -> tuple[Array, Array]: ...
    def heads_bwd(self, colors: Array, v_colors: Array) -> Array: ...
    def heads_sh_fwd(
        self, features: Array, directions: Array, rays_of: Array, density_scale: float
    ) -> tuple[Array, Array]: ...
    def heads_sh_bwd(
        self,
        features: Array,
        directions: Array,
        rays_of: Array,
        density_scale: float,
        v_sigmas: Array,
        v_colors: Array,
    ) -> Array: ...
    def heads_soft_fwd(self, features: Array, outputs: Array, density_scale: float) -> tuple[Array, Array]: ...
    def heads_soft_bwd(self, features: Array, density_scale: float, v_sigmas: Array, v_features: Array) -> None: ...
    def encode_points(self, points: Array, levels: int) -> Array: ...
    def encode_join(self, features: Array, rows: Array, rectify: bool) -> Array: ...
    def encode_join_bwd(self, v_joined: Array, features: Array, rectify: bool) -> Array: ...
    def intervals_along(
        self, origins: Array, directions: Array, edges: Array, offsets: Array, span: Span
    ) -> tuple[Array, Array]: ...
    def intervals_resample(
        self, edges: Array, weights: Array, draws: Array, padding: float, power: float, keep: bool
    ) -> Array: ...
    def weights_fwd(self, sigmas: Array, deltas: Array, count: int) -> Array: ...
    def weights_bwd(
        self, sigmas: Array, deltas: Array, count: int, weights: Array, v_weights: Array, v_sigmas: Array
    ) -> None: ...
    def frustums_encode(
        self, origins: Array, directions: Array, radii: Array, edges: Array, span: Span, levels: int
    ) -> tuple[Array, Array]: ...
    def histograms_interlevel(
        self, edges: Array, weights: Array, outer_edges: Array, outer_weights: Array, scale: float
    ) -> tuple[Array, Array]: ...
    def histograms_distortion(self, edges: Array, weights: Array, scale: float) -> tuple[Array, Array]: ...
    def rays_fwd(self, sigmas: Array, colors: Array, deltas: Array, first: Array, background: Any) -> RayColors: ...
    def rays_bwd(
        self,
        sigmas: Array,
        colors: Array,
        deltas: Array,
        first: Array,
        background: Any,
        transmittances: Array,
        v_rgb: Array,
    ) -> tuple[Array, Array]: ...
