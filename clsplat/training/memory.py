"""Device memory of a training, predicted from the buffers of each stage, and the photos kept in the rest."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from clsplat.config import TrainConfig
from clsplat.constants import GPU_TILE, SEGMENT
from clsplat.dataset.finding import DOWNSCALES
from clsplat.errors import InputError
from clsplat.scene import Scene, View

if TYPE_CHECKING:
    from clsplat.device import Device

INTERSECTIONS = 8.0
"""Assumed number of tiles per Gaussian: the mean over all Gaussians, in the view where it is largest (measured:
docs/howto/memory.md)."""

ROUNDING = 17 / 16
"""Factor by which the pool rounds up a block: to the next of 16 sizes per octave."""

REAL = 4  # bytes of a float32, a uint32 or an index

# What a stage allocates, in values of 4 bytes, as its file in clsplat/ops names them. Blocks of unlike sizes are not
# shared, so that the buffers of all stages add up.
PER_GAUSSIAN = {
    "project": 12,  # means2d 2, conics 3, depths, extents 2, opacities, colors 3
    "bin": 11,  # depth keys, tiles 4, sort keys and sort order twice, tiles per Gaussian and their sums
    "composite": 12 + 9,  # packed splats; v_means2d 2, v_conics 3, v_opacities, v_colors 3
    "observe": 2,  # grad_sum, seen
}
PER_GAUSSIAN_RAYS = 8 + 8 + 3  # rays; packed splats are larger; v_slopes
PER_GAUSSIAN_CHARTS = 9 + 8  # in charts of their own, rays and packed splats are larger still
JOINED = 12  # the splats once more, followed by those of the backdrop
PER_INTERSECTION = {
    "bin": 2,  # intersections twice
    "composite": 9,  # gradients per intersection
}
PER_INTERSECTION_RAYS = 4  # gradients per intersection
PER_GAUSSIAN_GPU = 2  # bin: tiles per Gaussian and their sums, in the order by depth
PER_INTERSECTION_GPU = 4  # bin: six lists while they are sorted, two of which are kept
PER_STATE = 4  # composite: transmittance and colour of a pixel where a segment begins
PER_INTERSECTION_PER_TILE = 4  # bin, on a CPU: list keys; of the sorts, what is not shared with the sort by depth
PER_PIXEL = {
    "composite": 4,  # image 3, alpha
    "loss": 3 + 9 + 1,  # v_image, derivatives of SSIM, v_alpha
    "photo": 1,  # 3 bytes, and one of a mask
}
PER_DEPTH = 2  # per Gaussian: the fourth channel of colors and v_colors
PER_INTERSECTION_DEPTH = 1
PER_PIXEL_DEPTH = 1 + 3 + 4 + 1  # the image's fourth channel, its colours apart, v_image with depth, inverse depths
PER_PIXEL_EXPOSURE = 3  # the image with the colours of its photo
PER_PIXEL_CHARTS = 3  # directions of rays
PER_ROW = 3 * 192  # derivatives of SSIM: rows have margins, and end with a work-item

COPIES = 3
"""Copies of all parameters: themselves and Adam's two moments."""


def bytes_text(size: int) -> str:
    """Format a number of bytes in GB or MB, powers of ten."""
    return f"{size / 1e9:.2f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


@dataclass(frozen=True)
class Footprint:
    """Device memory of training on photos of one size.

    Parameters
    ----------
    width, height : int
        Size of the largest photo, px.
    sh_degree : int
        Highest degree of the spherical harmonics.
    gpu : bool
        Whether the device is not a CPU: intersections are then sorted differently, and states of pixels saved.
    per_tile : bool
        Whether ``--sort per_tile`` is used.
    exposure : bool
        Whether ``--exposure`` is used.
    backdrop : int
        Number of Gaussians of the renderer's backdrop, which are drawn and do not train.
    rays : int
        With ``--projection ray`` 1, or 2 if a photo is not of a pinhole; otherwise 0.
    depth : bool
        Whether photos have depth maps.
    gpu_tile : int
        Edge of the tiles on a GPU, px.
    """

    width: int
    height: int
    sh_degree: int
    gpu: bool
    per_tile: bool = False
    exposure: bool = False
    backdrop: int = 0
    rays: int = 0
    depth: bool = False
    gpu_tile: int = GPU_TILE

    @classmethod
    def of(cls, scene: Scene, config: TrainConfig, device: "Device", backdrop: int = 0) -> "Footprint":
        """Footprint of training on the scene's photos."""
        cameras = [view.camera for view in scene.train + scene.test]
        width, height = max(c.width for c in cameras), max(c.height for c in cameras)
        per_tile = config.render.sort == "per_tile"
        own_charts = any(camera.model != "pinhole" for camera in cameras)
        rays = (config.render.projection == "ray") * (1 + own_charts)
        depth = any(view.depth is not None for view in scene.train)
        gpu, degree = not device.is_cpu, config.init.sh_degree
        tile = GPU_TILE if config.render.tile_size == "auto" else config.render.tile_size
        return cls(width, height, degree, gpu, per_tile, config.exposure, backdrop, rays, depth, tile)

    def per_gaussian(self, intersections: float = INTERSECTIONS) -> float:
        """Bytes per Gaussian, if each meets `intersections` tiles."""
        values = COPIES * self._parameters + sum(PER_GAUSSIAN.values()) + intersections * self._per_intersection
        values += (self.rays > 0) * PER_GAUSSIAN_RAYS + (self.rays > 1) * PER_GAUSSIAN_CHARTS + self.depth * PER_DEPTH
        values += self.gpu * PER_GAUSSIAN_GPU
        return REAL * ROUNDING * (values + (JOINED if self.backdrop else 0))

    @property
    def _parameters(self) -> int:
        return 11 + 3 * (self.sh_degree + 1) ** 2

    @property
    def _per_intersection(self) -> float:
        per_intersection: float = sum(PER_INTERSECTION.values()) + (self.rays > 0) * PER_INTERSECTION_RAYS
        per_intersection += self.depth * PER_INTERSECTION_DEPTH
        if self.gpu:
            return per_intersection + PER_INTERSECTION_GPU + PER_STATE * self.gpu_tile**2 / SEGMENT
        return per_intersection + self.per_tile * PER_INTERSECTION_PER_TILE

    @property
    def fixed(self) -> int:
        """Bytes that do not depend on the number of Gaussians."""
        per_pixel = sum(PER_PIXEL.values()) + self.exposure * PER_PIXEL_EXPOSURE
        per_pixel += (self.rays > 1) * PER_PIXEL_CHARTS + self.depth * PER_PIXEL_DEPTH
        return round(REAL * ROUNDING * self.height * (self.width * per_pixel + PER_ROW))

    def still(self, intersections: float = INTERSECTIONS) -> int:
        """Bytes for the backdrop, if each of its Gaussians meets `intersections` tiles."""
        values = self._parameters + sum(PER_GAUSSIAN.values()) + JOINED + intersections * self._per_intersection
        return round(REAL * ROUNDING * self.backdrop * values)

    def total(self, n: int, intersections: float = INTERSECTIONS) -> int:
        """Bytes for n Gaussians, if each meets `intersections` tiles; one photo is on the device."""
        return self.fixed + self.still(intersections) + round(n * self.per_gaussian(intersections))

    def most_gaussians(self, limit: int, intersections: float = INTERSECTIONS) -> int:
        """The largest number of Gaussians for which `total` is within `limit` bytes; 0 where none is."""
        left = limit - self.fixed - self.still(intersections)
        return max(0, int(left / self.per_gaussian(intersections)))

    def most_drawn(self, limit: int) -> int:
        """The largest number of Gaussians that are drawn, and do not train, within `limit` bytes; 0 where none is."""
        return max(0, int((limit - self.fixed) / replace(self, backdrop=1).still()))

    def check(self, start: int, limit: int, downscale: int = 1) -> None:
        """Check that `start` Gaussians fit `limit` bytes, with photos that are already `downscale` times smaller.

        Raises
        ------
        InputError
            If they do not; the message names what does.
        """
        if self.total(start) > limit:
            width, height = downscale * self.width, downscale * self.height
            smaller = {d: replace(self, width=width // d, height=height // d) for d in DOWNSCALES}
            fitting = [d for d, footprint in smaller.items() if footprint.total(start) <= limit]
            remedy = f" with all of them: --downscale {fitting[0]}" if fitting else ""
            raise InputError(
                f"--memory-limit: expected at least {bytes_text(self.total(start))} for {start} Gaussians at "
                f"{self.width}x{self.height}, found {bytes_text(limit)}; what fits at this size: "
                f"{self.most_gaussians(limit)} Gaussians{remedy}"
            )

    def describe(self, start: int, cap: int | None, limit: int) -> str:
        """A sentence on the memory of a training, from `start` Gaussians to at most `cap`, within `limit` bytes."""
        capped = "" if cap is None else f" {bytes_text(self.total(cap))} for {cap} (--max-gaussians),"
        return (
            f"memory: {bytes_text(self.total(start))} for {start} Gaussians,{capped} if each meets "
            f"{INTERSECTIONS:.0f} tiles; limit {bytes_text(limit)}, enough for {self.most_gaussians(limit)}"
        )


class Photos:
    """Photos, masks and inverse depths with their unit: on the device, uploaded when they are first needed and kept
    within a budget of bytes."""

    def __init__(self, device: "Device"):
        self._device = device
        self._kept: dict[str, tuple[Any, Any, Any, float]] = {}
        self._bytes = 0
        self._budget = 0

    def keep_within(self, budget: int) -> None:
        """Set the budget, bytes, and drop photos that exceed it."""
        self._budget = budget
        while self._kept and self._bytes > budget:
            _, dropped = self._kept.popitem()
            self._bytes -= _nbytes(dropped)

    def prefetch(self, view: View) -> None:
        """Begin to read a photo that is needed soon, unless it is on the device."""
        if view.name not in self._kept:
            view.prefetch()

    def __call__(self, view: View) -> tuple[Any, Any, Any, float]:
        if view.name in self._kept:
            return self._kept[view.name]
        # The memory of a CPU is that of the machine, in which photos that stream have a budget of their own.
        keeps = not (view.ahead and self._device.is_cpu)
        view = view.loaded()
        photo = self._device.upload("photo", view.image, np.uint8)
        mask = None if view.mask is None else self._device.upload("mask", view.mask, np.uint8)
        depths, unit = None, view.depth.unit if view.depth else 0.0
        if view.depth and unit:
            depths = self._device.upload("inverse depths", view.depth.disparities)
        found = photo, mask, depths, unit
        size = _nbytes(found)
        if keeps and self._bytes + size <= self._budget:
            self._kept[view.name] = found
            self._bytes += size
        return found


def _nbytes(kept: tuple[Any, ...]) -> int:
    return sum(array.nbytes for array in kept[:-1] if array is not None)
