"""Instant-NGP (Müller et al. 2022): a hash grid and two small networks."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from clsplat.field_stages import HashLevels, Samples
from clsplat.fields.field import Array, Field, Rays
from clsplat.fields.layers import Parameters, first_weights, moments, restore_parameters
from clsplat.fields.occupancy import CELLS, EVERY, THRESHOLD, Occupancy
from clsplat.fields.pixels import Batch
from clsplat.fields.space import Space
from clsplat.randomness import stream
from clsplat.scene import Color
from clsplat.stages import AdamStep

if TYPE_CHECKING:
    from clsplat.device import Device

DENSITY_WIDTHS, COLOR_WIDTHS = (32, 64, 16), (32, 64, 64, 16)
"""Widths of the two networks: one and two hidden layers of 64 (Müller et al. 2022, section 5.4); three colours are
padded to 16."""

LEVELS, COARSEST = 16, 16
"""Number of levels, and cells along an edge of the coarsest (Müller et al. 2022, table 1)."""

CELL_PIXELS, SPACE_CELL_PIXELS = 0.4, 1.0
"""Edge of a cell of the finest level, in widths of a pixel at the middle of the scene: in the unit cube, and where
there is a background. The paper's 2048 cells are as wide as the former for photos of 800 x 800 pixels (Müller et al.
2022, section 5.4). Finer cells are seen by single pixels."""

RATE, SPACE_RATE, RATE_FALL = 1e-2, 2e-2, 30.0
"""Learning rates at the start, in the unit cube (Müller et al. 2022, section 4) and where there is a background, and
by what they are divided at the end; exponential in between, over a training of any length."""

BETA1, BETA2, EPS = 0.9, 0.99, 1e-15
"""Constants of Adam (Müller et al. 2022, section 4)."""

TABLE_RANGE = 1e-4
"""Range of the table's first values, which are uniform (Müller et al. 2022, section 4)."""

FIRST_SAMPLES = 400
"""Approximate number of samples of a ray before the first update of the grid."""

RAYS_MAX = 32768
"""Largest number of rays in a step."""

EVALUATED = 1 << 18
"""Number of points at which densities for the grid are computed at once."""


class Evaluation(NamedTuple):
    """Results of the networks at samples, all on the device, for the gradients."""

    encoded: Any
    features: Any
    density_hidden: Any
    inputs: Any
    outputs: Any
    color_hidden: Any
    sigmas: Any
    colors: Any


class IngpBase(Field):
    """Instant-NGP with tables of 2^19 entries per level."""

    name = "ingp-base"
    entries, cells = 2**19, CELLS
    samples = 2**16
    """Approximate number of samples of a step. The paper has 2^18; a quarter of them, in more steps, trains faster on
    a CPU."""
    iterations = 3000
    halved = ("table",)

    def __init__(self, space: Space, device: "Device", seed: int):
        super().__init__(space, device, seed)
        cell = (SPACE_CELL_PIXELS if space.contracted else CELL_PIXELS) * space.pixel
        finest = max(round(space.edge / cell), COARSEST)
        self.levels = HashLevels.geometric(LEVELS, COARSEST, finest, self.entries)
        rng = stream(seed, "parameters of a field")
        table = rng.uniform(-TABLE_RANGE, TABLE_RANGE, (self.levels.offsets[-1], 2))
        networks = [first_weights(rng, widths) for widths in (DENSITY_WIDTHS, COLOR_WIDTHS)]
        self.parameters = {
            name: Parameters(device, values)
            for name, values in zip(("table", "density", "color"), (table, *networks), strict=True)
        }
        self.occupancy = Occupancy(np.full((self.cells,) * 3, THRESHOLD, np.float32))
        self._occupied = device.upload("occupied", self.occupancy.occupied, np.uint8)
        self._rays = self.samples // FIRST_SAMPLES

    @property
    def rays(self) -> int:
        """Number of rays of the next step, chosen so that they have about `samples` samples."""
        return self._rays

    def step(self, batch: Batch, progress: float) -> float:
        """See `Field`."""
        if self.iteration % EVERY == 0 and self.iteration:
            self._update_occupancy()
        self.iteration += 1
        upload = self.device.upload
        offsets = stream(self.seed, "offsets of samples", self.iteration).uniform(size=len(batch.origins))
        rays = upload("origins", batch.origins), upload("directions", batch.directions)
        samples = self.stages.march(*rays, upload("offsets", offsets), self._occupied, self.space.marching)
        if not samples.total:  # nothing is left in the way of these rays
            return float(np.mean((np.array(batch.background) - batch.colors) ** 2))
        self._rays = int(np.clip(len(offsets) * self.samples / samples.total, 64, RAYS_MAX))
        run = self._evaluate(samples, rays[1])
        composited = run.sigmas, run.colors, samples.deltas, samples.first, batch.background
        image = self.stages.rays_fwd(*composited)
        errors = image.rgb.get() - batch.colors
        v_rgb = upload("v_rgb", errors * (2 / errors.size))
        v_sigmas, v_colors = self.stages.rays_bwd(*composited, image.transmittances, v_rgb)
        self._descend(samples, run, v_sigmas, v_colors, progress)
        return float(np.mean(errors**2))

    def _evaluate(self, samples: Samples, directions: Any) -> Evaluation:
        stages, weights = self.stages, {name: p.values for name, p in self.parameters.items()}
        encoded = stages.hashgrid_fwd(samples.positions, weights["table"], self.levels)
        features, density_hidden = stages.mlp_fwd(encoded, weights["density"], DENSITY_WIDTHS)
        inputs = stages.heads_join(features, directions, samples.rays_of)
        outputs, color_hidden = stages.mlp_fwd(inputs, weights["color"], COLOR_WIDTHS)
        sigmas, colors = stages.heads_fwd(features, outputs)
        return Evaluation(encoded, features, density_hidden, inputs, outputs, color_hidden, sigmas, colors)

    def _descend(self, samples: Samples, run: Evaluation, v_sigmas: Any, v_colors: Any, progress: float) -> None:
        stages, parameters = self.stages, self.parameters
        v_outputs = stages.heads_bwd(run.colors, v_colors)
        color, density = parameters["color"].values, parameters["density"].values
        v_inputs, v_color = stages.mlp_bwd(
            run.inputs, color, COLOR_WIDTHS, run.color_hidden, v_outputs, COLOR_WIDTHS[0]
        )
        v_features = stages.heads_join_bwd(v_inputs, run.features, run.sigmas, v_sigmas)
        v_encoded, v_density = stages.mlp_bwd(
            run.encoded, density, DENSITY_WIDTHS, run.density_hidden, v_features, DENSITY_WIDTHS[0]
        )
        v_table = stages.hashgrid_bwd(samples.positions, v_encoded, self.levels)
        rate = (SPACE_RATE if self.space.contracted else RATE) * RATE_FALL**-progress
        step = AdamStep(self.iteration, {}, BETA1, BETA2, EPS, 0)
        for name, gradient in (("table", v_table), ("density", v_density), ("color", v_color)):
            p = parameters[name]
            stages.adam_array(p.values, gradient, p.first, p.second, rate, step, sparse=name == "table")

    def _update_occupancy(self) -> None:
        rng = stream(self.seed, "points of the grid", self.iteration)
        self.occupancy.update(self.iteration // EVERY - 1, rng, self._depths_at)
        self._occupied = self.device.upload("occupied", self.occupancy.occupied, np.uint8)

    def _depths_at(self, points: Array) -> Array:
        """Optical depths of the shortest step at points (P, 3) of the unit cube."""
        depths = np.empty(len(points))
        for begin in range(0, len(points), EVALUATED):
            part = slice(begin, begin + EVALUATED)
            positions = self.device.upload("positions", points[part])
            encoded = self.stages.hashgrid_fwd(positions, self.parameters["table"].values, self.levels)
            features, _ = self.stages.mlp_fwd(encoded, self.parameters["density"].values, DENSITY_WIDTHS)
            sigmas, _ = self.stages.heads_fwd(features, features)
            depths[part] = sigmas.get() * self.space.marching.step
        return depths

    def colors(self, rays: Rays, background: Color) -> Any:
        """See `Field`."""
        offsets = self.device.upload("offsets", np.full(len(rays.radii), 0.5))
        samples = self.stages.march(*rays[:2], offsets, self._occupied, self.space.marching)
        run = self._evaluate(samples, rays.directions)
        return self.stages.rays_fwd(run.sigmas, run.colors, samples.deltas, samples.first, background).rgb

    def model(self) -> dict[str, Array]:
        """See `Field`."""
        arrays = {name: p.values.get() for name, p in self.parameters.items()}
        return arrays | {"occupied": np.packbits(self.occupancy.occupied)}

    def optimiser(self) -> dict[str, Array]:
        """See `Field`."""
        return moments(self.parameters) | {"occupancy": self.occupancy.values, "rays": np.array(self._rays)}

    def restore(self, arrays: dict[str, Array]) -> None:
        """See `Field`."""
        restore_parameters(self.parameters, arrays, self.device.real)
        shape = self.occupancy.values.shape
        occupied = np.unpackbits(arrays["occupied"])[: self.occupancy.values.size].reshape(shape)
        if "occupancy" in arrays:
            self.occupancy, self._rays = Occupancy(arrays["occupancy"]), int(arrays["rays"])
        else:  # a model, which has no optical depths: `model` writes the same cells again
            self.occupancy = Occupancy(occupied.astype(np.float32))
        self._occupied = self.device.upload("occupied", occupied, np.uint8)

    def finish(self) -> None:
        """Round the table to half precision, in which the paper's code stores it."""
        table = self.parameters["table"].values
        table.set(table.get().astype(np.float16).astype(self.device.real))


class IngpBig(IngpBase):
    """Instant-NGP with tables of 2^21 entries per level."""

    name = "ingp-big"
    entries = 2**21
