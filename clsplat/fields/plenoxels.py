"""Plenoxels (Fridovich-Keil et al. 2022): a sparse grid of densities and spherical harmonics, without a network."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.field_stages import NO_ROW, Marching, Samples
from clsplat.fields.field import Array, Field, Rays
from clsplat.fields.pixels import Batch
from clsplat.fields.space import CONE, FAR, Space
from clsplat.randomness import stream
from clsplat.scene import Color
from clsplat.stages import AdamStep

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

SPACE_DENSITY_SCALE, SPACE_FIRST_DENSITY = 150.0, 0.05
"""The same two where there is a background. The first steps do not depend on the size of the gradients: at higher
rates they make cells close to the cameras opaque. Effect: docs/howto/fields.md."""

BETA2, EPS = 0.95, 1e-8
"""Constants of RMSProp (code of Fridovich-Keil et al. 2022). It is Adam without a mean of the gradients."""

TV_DENSITY, TV_HARMONICS = 1e-5, 1e-3
"""Weights of the total variation of densities, in inverse halves of an edge, and of harmonics, for synthetic scenes
(Fridovich-Keil et al. 2022, section 4 of the supplement). The paper's code ends this penalty with the first
refinement. If photos have few pixels for each cell, trainings then overfit. Here the penalty therefore stays until
the end, as in that code's settings for users' own captures."""

SPACE_TV_DENSITY, SPACE_TV_HARMONICS = 1.5, 15.0
"""The same where there is a background, for all steps together: each step has its part. Trainings of any length then
smooth as much (effect: docs/howto/fields.md). The paper has 5e-4 and 5e-3 in each of 128 000 steps, for photos that
face forward; steps here have more rays and larger cells."""

TV_SHARE = 100
"""Number of steps after which each corner has had the total variation in its gradient once (section 3.4)."""

TV_CELLS = 256
"""Cells along an edge for which differences are not scaled (equation 3)."""

EVENTS = ((0.1, "prune"), (0.2, "refine"), (0.35, "prune"), (0.5, "refine"), (0.7, "prune"))
"""Progress at which cells are pruned, or pruned and divided by two along each axis."""

CELL_PIXELS = 1.5
"""Smallest edge of a cell, in widths of a pixel at the distance of the middle of the scene. The paper's are 1.6 of
them: 512 cells for photos of 800 x 800 pixels."""

OCCUPIED_DEPTH = 0.02
"""Optical depth of a step at one of its corners from which a cell is kept when others are pruned. For 128 cells it is
a density of 2.6 of the paper, whose code keeps those above 5."""

FIRST_SAMPLES = 90
"""Approximate number of samples of a ray before the first pruning, for 64 cells."""

RAYS_MAX = 32768
"""Largest number of rays in a step."""


class Plenoxels(Field):
    """A sparse grid that is refined twice."""

    name = "plenoxels"
    cells = 64
    """Cells along an edge at the start. The paper starts with 128 or 256 and ends with 512."""
    samples = 2**16
    """Approximate number of samples of a step. The paper has 5000 rays, which have about as many."""
    iterations = 3000
    halved = ("table",)

    def __init__(self, space: Space, device: "Device", seed: int):
        super().__init__(space, device, seed)
        self._rays, self._events = self.samples // FIRST_SAMPLES, 0
        first, self._density_scale, self._variation = FIRST_DENSITY, DENSITY_SCALE, (TV_DENSITY, TV_HARMONICS)
        if space.contracted:
            first, self._density_scale = SPACE_FIRST_DENSITY, SPACE_DENSITY_SCALE
            self._variation = SPACE_TV_DENSITY, SPACE_TV_HARMONICS
        table = np.zeros(((self.cells + 1) ** 3, FEATURES))
        table[:, 0] = first / self._density_scale
        self._place(np.ones((self.cells,) * 3, np.uint8), table)

    def _place(self, occupied: NDArray[np.uint8], table: Array) -> None:
        """Set the occupied cells and the rows of their corners, in the order of the corners."""
        corners = np.flatnonzero(corners_of(occupied)).astype(np.uint32)
        index = np.full((len(occupied) + 1,) * 3, NO_ROW, np.uint32)
        index.reshape(-1)[corners] = np.arange(len(corners), dtype=np.uint32)
        self.occupied, self.corners = occupied, corners
        upload = self.device.upload
        self._occupied, self._index = upload("occupied", occupied, np.uint8), upload("index", index, np.uint32)
        self._corners = upload("corners", corners, np.uint32)
        self.table, self._squares = upload("table", table), upload("squares", np.zeros(table.shape))

    @property
    def rays(self) -> int:
        """Number of rays of the next step, chosen so that they have about `samples` samples."""
        return self._rays

    @property
    def _marching(self) -> Marching:
        step = STEP_CELLS / len(self.occupied)
        if not self.space.contracted:
            return Marching(step, 0.0, 0.0, 1e6, False)
        return Marching(self.space.edge * step, CONE, self.space.near, FAR, True)

    def step(self, batch: Batch, progress: float) -> float:
        """See `Field`."""
        while self._events < len(EVENTS) and progress >= EVENTS[self._events][0]:
            self._prune()
            if EVENTS[self._events][1] == "refine" and self._resolved():
                self._refine()
            self._events += 1
        self.iteration += 1
        upload, stages = self.device.upload, self.stages
        offsets = stream(self.seed, "offsets of samples", self.iteration).uniform(size=len(batch.origins))
        rays = upload("origins", batch.origins), upload("directions", batch.directions)
        samples = stages.march(*rays, upload("offsets", offsets), self._occupied, self._marching)
        if not samples.total:  # nothing is left in the way of these rays
            return float(np.mean((np.array(batch.background) - batch.colors) ** 2))
        self._rays = int(np.clip(len(offsets) * self.samples / samples.total, 64, RAYS_MAX))
        features = stages.voxels_fwd(samples.positions, self._index, self.table)
        head = features, rays[1], samples.rays_of, self._density_scale
        sigmas, colors = stages.heads_sh_fwd(*head)
        composited = sigmas, colors, samples.deltas, samples.first, batch.background
        image = stages.rays_fwd(*composited)
        errors = image.rgb.get() - batch.colors
        v_rgb = upload("v_rgb", errors * (2 / errors.size))
        v_features = stages.heads_sh_bwd(*head, *stages.rays_bwd(*composited, image.transmittances, v_rgb))
        self._descend(samples, v_features, progress)
        return float(np.mean(errors**2))

    def _descend(self, samples: Samples, v_features: Any, progress: float) -> None:
        rows = self.table.shape[0]
        gradient = self.stages.voxels_bwd(samples.positions, self._index, rows, v_features)
        count = -(-rows // TV_SHARE)
        scale = len(self.occupied) / TV_CELLS / count
        density, harmonics = self._variation
        if self.space.contracted:
            part = progress / max(1, self.iteration - 1)  # of the training in a step; 0 in the first one
            density, harmonics = part * density, part * harmonics
        weights = density * scale * self._density_scale / 2, harmonics * scale
        variation = self._index, self._corners, self.table, gradient
        self.stages.voxels_tv(*variation, weights, self.iteration * count % rows, count)
        rate = RATE * (RATE_FINAL / RATE) ** progress
        step = AdamStep(self.iteration, {}, 0.0, BETA2, EPS, 0)
        # With beta1 = 0 the mean of the gradients is the gradient, which is where it is already.
        self.stages.adam_array(self.table, gradient, gradient, self._squares, rate, step, sparse=True)

    def _resolved(self) -> bool:
        """Whether the photos' pixels are small enough for cells of half the edge."""
        return self.space.edge / (2 * len(self.occupied)) >= CELL_PIXELS * self.space.pixel

    def _prune(self) -> None:
        """Keep the cells with a dense corner, and those around them."""
        from scipy.ndimage import maximum_filter

        cells, table = len(self.occupied), self.table.get()
        densities = np.zeros((cells + 1) ** 3, np.float32)
        densities[self.corners] = self._density_scale * table[:, 0]
        dense = densities.reshape((cells + 1,) * 3) * (STEP_CELLS / cells) > OCCUPIED_DEPTH
        kept = maximum_filter(cells_of(dense), 3, mode="constant") & (self.occupied != 0)
        if not kept.any():  # a field that is empty may still become dense
            return
        rows = corners_of(kept).reshape(-1)[self.corners]
        self._place(kept.astype(np.uint8), table[rows])

    def _refine(self) -> None:
        """Divide each cell by two along each axis; new corners are interpolated."""
        occupied = self.occupied
        for axis in range(3):
            occupied = np.repeat(occupied, 2, axis=axis)
        places = np.argwhere(corners_of(occupied))[:, ::-1] / len(occupied)
        positions = self.device.upload("positions", places)
        self._place(occupied, self.stages.voxels_fwd(positions, self._index, self.table).get())

    def colors(self, rays: Rays, background: Color) -> Any:
        """See `Field`."""
        offsets = self.device.upload("offsets", np.full(len(rays.radii), 0.5))
        samples = self.stages.march(*rays[:2], offsets, self._occupied, self._marching)
        features = self.stages.voxels_fwd(samples.positions, self._index, self.table)
        sigmas, colors = self.stages.heads_sh_fwd(features, rays.directions, samples.rays_of, self._density_scale)
        return self.stages.rays_fwd(sigmas, colors, samples.deltas, samples.first, background).rgb

    def model(self) -> dict[str, Array]:
        """See `Field`."""
        shape = np.array(len(self.occupied))
        return {"table": self.table.get(), "cells": shape, "occupied": np.packbits(self.occupied)}

    def optimiser(self) -> dict[str, Array]:
        """See `Field`."""
        return {"squares": self._squares.get(), "counters": np.array([self._rays, self._events])}

    def restore(self, arrays: dict[str, Array]) -> None:
        """See `Field`."""
        cells = int(arrays["cells"])
        occupied = np.unpackbits(arrays["occupied"])[: cells**3].reshape((cells,) * 3)
        self._place(occupied, arrays["table"])
        if "squares" in arrays:
            self._squares = self.device.upload("squares", arrays["squares"])
            self._rays, self._events = map(int, arrays["counters"])

    def finish(self) -> None:
        """Round the table to half precision. The paper's code stores harmonics in it, too."""
        self.table.set(self.table.get().astype(np.float16).astype(self.device.real))


def corners_of(occupied: Array) -> NDArray[np.bool_]:
    """Corners (N + 1, N + 1, N + 1) of the occupied cells (N, N, N)."""
    corners = np.zeros(tuple(n + 1 for n in occupied.shape), bool)
    n = len(occupied)
    for k in range(8):
        z, y, x = k >> 2, k >> 1 & 1, k & 1
        corners[z : z + n, y : y + n, x : x + n] |= occupied != 0
    return corners


def cells_of(corners: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (N, N, N) with at least one of the corners (N + 1, N + 1, N + 1)."""
    n = len(corners) - 1
    cells = np.zeros((n,) * 3, bool)
    for k in range(8):
        z, y, x = k >> 2, k >> 1 & 1, k & 1
        cells |= corners[z : z + n, y : y + n, x : x + n]
    return cells
