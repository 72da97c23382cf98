"""Mip-NeRF 360 (Barron et al. 2022): cones, and a proposal network that sets where the large one is evaluated."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from clsplat.field_stages import CHUNK_WIDTH, frustum_width
from clsplat.fields.field import Array, Rays
from clsplat.fields.layers import (
    VIEW_LEVELS,
    Asked,
    NetworkField,
    Parameters,
    ViewNetwork,
    descend,
    first_weights,
)
from clsplat.fields.pixels import Batch
from clsplat.fields.space import Space
from clsplat.randomness import stream
from clsplat.scene import Color
from clsplat.stages import AdamStep

if TYPE_CHECKING:
    from clsplat.device import Device

ROUNDS = 2
"""Times that the proposal network is asked along a ray (Barron et al. 2022, section 3)."""

PADDING = 0.0025
"""Added to the weights of intervals before new edges are drawn. The paper widens the intervals instead; Mip-NeRF adds
a hundredth, with four times as many samples (Barron et al. 2021, equation 18)."""

ANNEAL_SLOPE = 10.0
"""Slope of the power of the weights at the start, which rises from 0 to 1 (Barron et al. 2022, equation 18)."""

DISTORTION = 0.001
"""Weight of the distortion loss. The paper has 0.01 (Barron et al. 2022, section 4), beside a loss of the colours
that is linear in large errors. With that one the field of an object became empty, because most rays see the
background. Squared errors, as for all other methods, have smaller gradients."""

WARM_UP = 100
"""Steps in which the learning rate rises to its value. The paper has 512 of 250 000."""

BETA1, BETA2, EPS = 0.9, 0.999, 1e-6
"""Constants of Adam (Barron et al. 2022, supplement)."""


class Proposed(NamedTuple):
    """A round of the proposal network, all on the device."""

    edges: Any
    encoded: Any
    outputs: Any
    hidden: Any
    sigmas: Any
    deltas: Any
    weights: Any


class Seen(NamedTuple):
    """Both rounds, and what the large network was asked then; the colours and transmittances of the rays."""

    rounds: list[Proposed]
    edges: Any
    asked: Asked
    deltas: Any
    first: Any
    weights: Any
    image: Any


class MipNerf360(NetworkField):
    """Mip-NeRF 360 with the paper's networks."""

    name = "mip-nerf360"
    depth, width, features, color_width = 8, 1024, 256, 128
    """Layers of the large network, their width, its features and the width of its layer of colours."""
    proposal_depth, proposal_width = 4, 256
    levels = 12
    """Frequencies of points."""
    proposals, samples = 64, 32
    """Intervals of a round, and of the large network (Barron et al. 2022, section 4)."""
    rays = 512
    """Rays of a step. The paper has 16384."""
    rate, rate_final = 2e-3, 2e-5
    """Learning rates at the start and at the end, exponential in between (Barron et al. 2022, supplement)."""
    iterations = 5000

    def __init__(self, space: Space, device: "Device", seed: int):
        super().__init__(space, device, seed)
        inputs = frustum_width(self.levels)
        self.network = ViewNetwork(inputs, self.depth, self.width, self.features, self.color_width)
        self.proposal_widths = (inputs, *[self.proposal_width] * self.proposal_depth, CHUNK_WIDTH)
        rng = stream(seed, "parameters of a field")
        self.parameters = self.network.parameters(device, rng, "field")
        self.parameters["proposal"] = Parameters(device, first_weights(rng, self.proposal_widths))

    def step(self, batch: Batch, progress: float) -> float:
        """See `Field`."""
        self.iteration += 1
        rng = stream(self.seed, "offsets of samples", self.iteration)
        upload, count = self.device.upload, len(batch.origins)
        rays = Rays(*(upload("rays", array) for array in (batch.origins, batch.directions, batch.radii)))
        power = ANNEAL_SLOPE * progress / ((ANNEAL_SLOPE - 1) * progress + 1)
        seen = self._look(rays, rng.uniform(size=(ROUNDS + 1, count)), power, batch.background)
        errors = seen.image.rgb.get() - batch.colors
        v_rgb = upload("v_rgb", errors * (2 / errors.size))
        gradients = self._gradients(seen, v_rgb, batch.background) | {"proposal": self._proposal_gradient(seen)}
        rate = self.rate * (self.rate_final / self.rate) ** progress * min(1.0, self.iteration / WARM_UP)
        descend(self.stages, self.parameters, gradients, rate, AdamStep(self.iteration, {}, BETA1, BETA2, EPS, 0))
        return float(np.mean(errors**2))

    def _gradients(self, seen: Seen, v_rgb: Any, background: Color) -> dict[str, Any]:
        """Gradients of the large network's weights: by the colours and by the distortion."""
        stages, asked = self.stages, seen.asked
        composited = asked.sigmas, asked.colors, seen.deltas, seen.first, background
        v_sigmas, v_colors = stages.rays_bwd(*composited, seen.image.transmittances, v_rgb)
        _, v_weights = stages.histograms_distortion(seen.edges, seen.weights, DISTORTION / len(v_rgb))
        stages.weights_bwd(asked.sigmas, seen.deltas, self.samples, seen.weights, v_weights, v_sigmas)
        scale = self.space.density_scale
        found = self.network.gradients(stages, self._weights(), asked, scale, v_sigmas, v_colors)
        return {f"field.{part}": gradient for part, gradient in found.items()}

    def _proposal_gradient(self, seen: Seen) -> Any:
        """Gradient of the proposal network's weights: the sum over the rounds."""
        stages, empty, weights = self.stages, self.device.empty, self.parameters["proposal"].values
        v = None
        for round_ in seen.rounds:
            outer = round_.edges, round_.weights
            _, v_weights = stages.histograms_interlevel(seen.edges, seen.weights, *outer, 1 / len(seen.weights))
            v_sigmas = empty("v_sigmas", round_.sigmas.shape).fill(0)
            arguments = round_.sigmas, round_.deltas, self.proposals, round_.weights
            stages.weights_bwd(*arguments, v_weights, v_sigmas)
            v_outputs = empty("v_outputs", round_.outputs.shape).fill(0)
            stages.heads_soft_bwd(round_.outputs, self.space.density_scale, v_sigmas, v_outputs)
            network = round_.encoded, weights, self.proposal_widths, round_.hidden
            v = stages.mlp_bwd(*network, v_outputs, 0, v)[1]
        return v

    def _weights(self) -> dict[str, Any]:
        return {part: self.parameters[f"field.{part}"].values for part in self.network.widths}

    def _look(self, rays: Rays, places: Array, power: float, background: Color) -> Seen:
        """Ask both networks along rays.

        Parameters
        ----------
        rays : Rays
        places : (ROUNDS + 1, R)
            Of the draws of a ray in their shares of the distribution, in [0, 1).
        power : float
            Of the weights, from which edges are drawn.
        background : RGB
        """
        stages, constant, count = self.stages, self.device.constant, places.shape[1]
        edges, weights = constant("edges", np.tile([0.0, 1.0], (count, 1))), constant("weights", np.ones(count))
        rounds: list[Proposed] = []
        scale, span = self.space.density_scale, self.space.span
        for place in places[:-1]:
            edges = self._resample(edges, weights, place, self.proposals, power)
            encoded, deltas = stages.frustums_encode(*rays, edges, span, self.levels)
            network = self.parameters["proposal"].values, self.proposal_widths
            outputs, hidden = stages.mlp_fwd(encoded, *network)
            sigmas, _ = stages.heads_soft_fwd(outputs, outputs, scale)
            weights = stages.weights_fwd(sigmas, deltas, self.proposals)
            rounds.append(Proposed(edges, encoded, outputs, hidden, sigmas, deltas, weights))
        edges = self._resample(edges, weights, places[-1], self.samples, power)
        encoded, deltas = stages.frustums_encode(*rays, edges, span, self.levels)
        views = stages.encode_points(rays.directions, VIEW_LEVELS)
        asked = self.network.ask(stages, self._weights(), encoded, views, scale)
        weights = stages.weights_fwd(asked.sigmas, deltas, self.samples)
        first = constant("first samples", np.arange(count + 1) * self.samples, np.uint32)
        image = stages.rays_fwd(asked.sigmas, asked.colors, deltas, first, background)
        return Seen(rounds, edges, asked, deltas, first, weights, image)

    def _resample(self, edges: Any, weights: Any, place: Array, intervals: int, power: float) -> Any:
        """Edges of new intervals. All draws of a ray have the same place in their shares."""
        draws = self.device.upload("draws", np.repeat(place[:, None], intervals + 1, axis=1))
        return self.stages.intervals_resample(edges, weights, draws, PADDING, power, False)

    def colors(self, rays: Rays, background: Color) -> Any:
        """See `Field`."""
        return self._look(rays, np.full((ROUNDS + 1, len(rays.radii)), 0.5), 1.0, background).image.rgb


class MipNerf360Small(MipNerf360):
    """Mip-NeRF 360 with networks that two cores train within an hour."""

    name = "mip-nerf360-small"
    depth, width, features, color_width = 4, 64, 64, 32
    proposal_depth, proposal_width = 2, 64
    levels = 8
    rays = 256
    rate, rate_final = 4e-3, 4e-4
    """Twice that of the paper at the start, for networks of a sixteenth of the width and few steps."""
    iterations = 3000
