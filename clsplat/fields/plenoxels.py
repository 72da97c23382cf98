"""Plenoxels (Fridovich-Keil et al. 2022): a sparse grid of densities and spherical harmonics, without a network."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import Marching
from clsplat.fields.field import Array, Field, Rays
from clsplat.fields.pixels import Batch
from clsplat.fields.space import CUBE_FAR, Space
from clsplat.fields.sparse_grid import Seen, SparseGrid
from clsplat.randomness import stream
from clsplat.scene import Color

if TYPE_CHECKING:
    from clsplat.device import Device

FEATURES = 28
"""Numbers of a corner: a density, and nine coefficients of spherical harmonics of degree 2 for each colour."""

STEP_CELLS = 0.5
"""Length of a step in edges of a cell (Fridovich-Keil et al. 2022, section 3.1)."""

RATE, RATE_FINAL = 1e-2, 3e-3
"""Learning rates of the harmonics at the start (section 4 of the supplement) and at the end; exponential in between.
That of the paper falls to 2e-4 in 128 000 steps, which is too low for the few steps here."""

DENSITY_SCALE = 600.0
"""Density of a stored value of 1, in inverse edges of the unit cube. RMSProp's steps do not depend on the scale of a
gradient, so this is the ratio of the learning rates of densities and harmonics: a tenth of that of the paper, which
raises the rate of the densities from a hundredth during its first 15 000 steps, more than a training has here."""

FIRST_DENSITY = 0.2
"""Density at the start, in inverse edges of the unit cube: 0.1 of the paper, whose cube has edges of 2."""

SPACE_DENSITY_SCALE, SPACE_FIRST_DENSITY = 300.0, 0.1
"""The same two where there is a background. The first steps do not depend on the size of the gradients: at higher
rates they make cells close to the cameras opaque. Effect: docs/howto/fields.md."""

SPACE_STEP_SHARE = 1 / 32
"""Length of a step per distance where there is a background, if that is more than `STEP_CELLS`. Steps of half a cell
leave half as many rays in a step of the training. Effect: docs/howto/fields.md."""

TV_DENSITY, TV_HARMONICS = 1e-5, 1e-3
"""Weights of the total variation of densities, in inverse halves of an edge, and of harmonics, for synthetic scenes
(Fridovich-Keil et al. 2022, section 4 of the supplement). The paper's code ends this penalty with the first
refinement. If photos have few pixels for each cell, trainings then overfit. Here the penalty therefore stays until
the end, as in that code's settings for users' own captures."""

SPACE_TV_DENSITY, SPACE_TV_HARMONICS = 1.5, 30.0
"""The same where there is a background, for all steps together: each step has its part. Trainings of any length then
smooth as much (effect: docs/howto/fields.md). The paper has 5e-5 and 5e-3 in each of 102 400 steps, which have fewer
rays and smaller cells."""

TV_CELLS = 256
"""Cells along an edge for which differences are not scaled (equation 3)."""

EVENTS = ((0.1, "prune"), (0.2, "refine"), (0.35, "prune"), (0.5, "refine"), (0.7, "prune"))
"""Progress at which cells are pruned, or pruned and divided by two along each axis."""

CELL_PIXELS = 1.5
"""Smallest edge of a cell, in widths of a pixel at the distance of the middle of the scene. The paper's are 1.6 of
them: 512 cells for photos of 800 x 800 pixels."""

OCCUPIED_DEPTH = 0.02
"""Optical depth of a step at one of its corners from which a cell is kept when others are pruned. For 128 cells of a
cube it is a density of 2.6 of the paper, whose code keeps those above 5."""

FIRST_SAMPLES = 90
"""Approximate number of samples of a ray before the first pruning, for 64 cells."""

RAYS_MAX = 32768
"""Largest number of rays in a step."""

SPHERES = 64
"""Cells between the unit ball and infinity after two refinements, equally spaced in inverse radius. The paper has 64
spheres from the start."""

SPHERE_PIXELS = 3.0
"""Width of a cell of the spheres at the equator after two refinements, in pixels. Effect: docs/howto/fields.md."""

LONGITUDES_MAX = 1024
"""Largest number of longitudes of the spheres, which bounds their memory. The paper has 2048."""

SPHERE_DENSITY_SCALE, SPHERE_FIRST_DENSITY = 150.0, 0.05
"""Density of a stored value of 1 on the spheres, and density at the start, in inverse contracted lengths."""

SPHERE_RATE = 0.05
"""Learning rate of the spheres at the start. It falls as the one of the harmonics. The paper's code has 0.1 for the
colours; there are no harmonics here that share a colour."""

SPHERE_TV_DENSITY, SPHERE_TV_COLOR = 1.0, 5.0
"""Weights of the total variation of the spheres, for all steps together: differences of contracted densities and of
colours, not scaled by the size of cells. Effect: docs/howto/fields.md."""


class Plenoxels(Field):
    """A sparse grid that is refined twice, and spheres around it."""

    name = "plenoxels"
    cells = 64
    """Cells along an edge at the start. The paper starts with 128 or 256 and ends with 512."""
    samples = 2**16
    """Approximate number of samples of a step. The paper has 5000 rays, which have about as many."""
    iterations = 3000
    halved = ("table", "spheres_table")

    def __init__(self, space: Space, device: "Device", seed: int):
        super().__init__(space, device, seed)
        self._rays, self._events = self.samples // FIRST_SAMPLES, 0
        self._spheres: SparseGrid | None = None
        cells, row = self.cells, np.zeros(FEATURES)
        first, scale, self._variation = FIRST_DENSITY, DENSITY_SCALE, (TV_DENSITY, TV_HARMONICS)
        if space.contracted:
            cells //= 2  # the spheres have the others
            first, scale = SPACE_FIRST_DENSITY, SPACE_DENSITY_SCALE
            self._variation = SPACE_TV_DENSITY, SPACE_TV_HARMONICS
            finest = min(LONGITUDES_MAX, 2 * np.pi / (SPHERE_PIXELS * space.pixel))
            longitudes = 2 * max(1, round(finest / 8))  # an even number, of which the finest is four times as many
            around = np.ones((SPHERES // 4, longitudes // 2, longitudes), np.uint8)
            outer = np.array([SPHERE_FIRST_DENSITY / SPHERE_DENSITY_SCALE, 0, 0, 0])
            args = self.stages, device, around, outer, SPHERE_DENSITY_SCALE
            self._spheres = SparseGrid(*args, closed=True)
        row[0] = first / scale
        occupied = in_ball(cells) if space.contracted else np.ones((cells,) * 3, np.uint8)
        self._grid = SparseGrid(self.stages, device, occupied, row, scale)

    @property
    def rays(self) -> int:
        """Number of rays of the next step, chosen so that they have about `samples` samples."""
        return self._rays

    @property
    def _marching(self) -> Marching:
        share = SPACE_STEP_SHARE if self.space.contracted else 0.0
        step = STEP_CELLS / len(self._grid.occupied)
        return Marching(step, share, self.space.near / self._edge, CUBE_FAR, False)

    @property
    def _edge(self) -> float:
        """Edge of the cube of the grid, in field coordinates: the unit ball is two wide."""
        return 2.0 if self.space.contracted else 1.0

    def _see(self, origins: Array, directions: Any, offsets: Any, background: Color) -> tuple[Seen, Seen | None]:
        """What rays see of the grid, and of the spheres behind it; origins (R, 3) are on the host."""
        upload, behind, shown, inside = self.device.upload, None, background, origins
        if self._spheres is not None:
            inside = origins / self._edge + 0.5
            there = upload("origins", origins), directions, offsets, self._spheres.cells
            behind = self._spheres.see(self.stages.spheres(*there, self.space.near), directions, background)
            shown = behind.image.rgb
        there = upload("origins", inside), directions, offsets, self._grid.cells
        return self._grid.see(self.stages.march(*there, self._marching), directions, shown), behind

    def step(self, batch: Batch, progress: float) -> float:
        """See `Field`."""
        while self._events < len(EVENTS) and progress >= EVENTS[self._events][0]:
            self._change(EVENTS[self._events][1] == "refine")
            self._events += 1
        self.iteration += 1
        upload, count = self.device.upload, len(batch.origins)
        offsets = stream(self.seed, "offsets of samples", self.iteration).uniform(size=count)
        rays = batch.origins, upload("directions", batch.directions), upload("offsets", offsets)
        seen, behind = self._see(*rays, batch.background)
        total = seen.samples.total + (behind.samples.total if behind else 0)
        if total:
            self._rays = int(np.clip(count * self.samples / total, 64, RAYS_MAX))
        errors = seen.image.rgb.get() - batch.colors
        v_rgb, rate = errors * (2 / errors.size), (RATE_FINAL / RATE) ** progress
        # Smoothing has a part of the training where there is a background; 0 in the first step.
        part = progress / max(1, self.iteration - 1) if self.space.contracted else 1.0
        if seen.samples.total:
            gradient, scale = self._grid.gradient(seen, upload("v_rgb", v_rgb)), len(self._grid.occupied) / TV_CELLS
            weights = part * scale * self._variation[0] / 2, part * scale * self._variation[1]
            self._grid.descend(gradient, weights, RATE * rate, self.iteration)
        if self._spheres is not None and behind and behind.samples.total:
            v_behind = v_rgb * seen.image.behind.get()[:, None]
            gradient = self._spheres.gradient(behind, upload("v_rgb", v_behind))
            weights = part * SPHERE_TV_DENSITY, part * SPHERE_TV_COLOR
            self._spheres.descend(gradient, weights, SPHERE_RATE * rate, self.iteration)
        return float(np.mean(errors**2))

    def _change(self, refine: bool) -> None:
        """Prune the grid and the spheres, and refine them."""
        self._grid.prune(OCCUPIED_DEPTH * len(self._grid.occupied) / STEP_CELLS)
        if refine and self._resolved():
            self._grid.refine()
        if self._spheres is not None:
            self._spheres.prune(OCCUPIED_DEPTH * len(self._spheres.occupied))
            if refine:
                self._spheres.refine()

    def _resolved(self) -> bool:
        """Whether the photos' pixels are small enough for cells of half the edge."""
        return self._edge / (2 * len(self._grid.occupied)) >= CELL_PIXELS * self.space.pixel

    def colors(self, rays: Rays, background: Color) -> Any:
        """See `Field`."""
        offsets = self.device.upload("offsets", np.full(len(rays.radii), 0.5))
        return self._see(rays.origins.get(), rays.directions, offsets, background)[0].image.rgb

    def _parts(self) -> dict[str, SparseGrid]:
        """The grid and the spheres, with the beginnings of the names of their arrays."""
        return {"": self._grid} | ({} if self._spheres is None else {"spheres_": self._spheres})

    def model(self) -> dict[str, Array]:
        """See `Field`."""
        return {start + name: array for start, part in self._parts().items() for name, array in part.model().items()}

    def optimiser(self) -> dict[str, Array]:
        """See `Field`."""
        squares = {f"{start}squares": part.squares.get() for start, part in self._parts().items()}
        return squares | {"counters": np.array([self._rays, self._events])}

    def restore(self, arrays: dict[str, Array]) -> None:
        """See `Field`."""
        for start, part in self._parts().items():
            part.restore(*(arrays[start + name] for name in ("table", "cells", "occupied")))
            if f"{start}squares" in arrays:
                part.squares.set(arrays[f"{start}squares"].astype(self.device.real).reshape(part.squares.shape))
        if "counters" in arrays:
            self._rays, self._events = map(int, arrays["counters"])

    def finish(self) -> None:
        """Round the tables to half precision. The paper's code stores harmonics in it, too."""
        for part in self._parts().values():
            part.round()


def in_ball(cells: int) -> NDArray[np.uint8]:
    """Cells (N, N, N) of a cube whose middle lies in the ball that the cube encloses."""
    middles = (np.arange(cells) + 0.5) / cells * 2 - 1
    z, y, x = np.meshgrid(middles, middles, middles, indexing="ij")
    return (x**2 + y**2 + z**2 < 1).astype(np.uint8)
