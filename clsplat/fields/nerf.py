"""NeRF (Mildenhall et al. 2020): a network evaluated at 64 samples of a ray, and another at these and 128 more."""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from clsplat.field_stages import RayColors, encoded_width
from clsplat.fields.field import Array, Rays
from clsplat.fields.layers import (
    VIEW_LEVELS,
    Asked,
    NetworkField,
    ViewNetwork,
    descend,
)
from clsplat.fields.pixels import Batch
from clsplat.fields.space import Space
from clsplat.randomness import stream
from clsplat.scene import Color
from clsplat.stages import AdamStep

if TYPE_CHECKING:
    from clsplat.device import Device

POINT_LEVELS = 10
"""Frequencies of points (Mildenhall et al. 2020, section 5.1)."""

PADDING = 1e-5
"""Added to the weights of intervals before new samples are drawn (code of Mildenhall et al. 2020)."""

BETA1, BETA2, EPS = 0.9, 0.999, 1e-7
"""Constants of Adam (Mildenhall et al. 2020, section 5.3; the epsilon is that of its library)."""


class Seen(NamedTuple):
    """Pass of a network along rays, all on the device: its inputs, the lengths, and the colours of rays."""

    asked: Asked
    deltas: Any
    first: Any
    image: RayColors


class Nerf(NetworkField):
    """NeRF with the paper's networks."""

    name = "nerf"
    depth, width = 8, 256
    """Layers, and their width, of both networks."""
    coarse, fine = 64, 128
    """Samples of the coarse network, and draws of the fine one, which is asked at both (Mildenhall et al. 2020,
    section 5.3)."""
    rays = 512
    """Rays of a step. The paper has 4096."""
    rate, rate_final = 5e-4, 5e-5
    """Learning rates at the start and at the end, exponential in between (Mildenhall et al. 2020, section 5.3)."""
    iterations = 5000

    def __init__(self, space: Space, device: "Device", seed: int):
        super().__init__(space, device, seed)
        inputs = encoded_width(POINT_LEVELS)
        self.network = ViewNetwork(inputs, self.depth, self.width, self.width, self.width // 2)
        rng = stream(seed, "parameters of a field")
        self.parameters = {
            key: value
            for name in ("coarse", "fine")
            for key, value in self.network.parameters(device, rng, name).items()
        }

    def step(self, batch: Batch, progress: float) -> float:
        """See `Field`."""
        self.iteration += 1
        rng = stream(self.seed, "offsets of samples", self.iteration)
        upload, stages = self.device.upload, self.stages
        rays = Rays(*(upload("rays", array) for array in (batch.origins, batch.directions, batch.radii)))
        passes = self._look(rays, lambda *shape: rng.uniform(size=shape), batch.background)
        gradients: dict[str, Any] = {}
        errors = np.zeros(0)
        for name, seen in passes.items():
            errors = seen.image.rgb.get() - batch.colors
            v_rgb = upload("v_rgb", errors * (2 / errors.size))
            composited = seen.asked.sigmas, seen.asked.colors, seen.deltas, seen.first, batch.background
            v = stages.rays_bwd(*composited, seen.image.transmittances, v_rgb)
            found = self.network.gradients(stages, self._weights(name), seen.asked, self.space.density_scale, *v)
            gradients |= {f"{name}.{part}": gradient for part, gradient in found.items()}
        rate = self.rate * (self.rate_final / self.rate) ** progress
        descend(stages, self.parameters, gradients, rate, AdamStep(self.iteration, {}, BETA1, BETA2, EPS, 0))
        return float(np.mean(errors**2))

    def _weights(self, name: str) -> dict[str, Any]:
        return {part: self.parameters[f"{name}.{part}"].values for part in self.network.widths}

    def _look(self, rays: Rays, draw: Any, background: Color) -> dict[str, Seen]:
        """Both passes along rays. `draw(*shape)` has places of samples in their intervals, in [0, 1)."""
        upload, stages, count = self.device.upload, self.stages, len(rays.radii)
        edges = self.device.constant("edges", np.tile(np.linspace(0, 1, self.coarse + 1), (count, 1)))
        views = stages.encode_points(rays.directions, VIEW_LEVELS)
        along = rays.origins, rays.directions, views
        coarse = self._pass("coarse", along, edges, draw(count, self.coarse), background)
        weights = stages.weights_fwd(coarse.asked.sigmas, coarse.deltas, self.coarse)
        edges = stages.intervals_resample(edges, weights, upload("draws", draw(count, self.fine)), PADDING, 1.0, True)
        offsets = draw(count, self.coarse + self.fine)
        return {
            "coarse": coarse,
            "fine": self._pass("fine", along, edges, offsets, background),
        }

    def _pass(self, name: str, rays: tuple[Any, Any, Any], edges: Any, offsets: Array, background: Color) -> Seen:
        """Ask a network once in each interval of rays, which are origins, directions and encoded directions."""
        origins, directions, views = rays
        stages, (count, per) = self.stages, offsets.shape
        places = self.device.upload("offsets", offsets)
        points, deltas = stages.intervals_along(origins, directions, edges, places, self.space.span)
        encoded = stages.encode_points(points, POINT_LEVELS)
        asked = self.network.ask(stages, self._weights(name), encoded, views, self.space.density_scale)
        first = self.device.constant(f"first samples, {name}", np.arange(0, count * per + 1, per), np.uint32)
        image = stages.rays_fwd(asked.sigmas, asked.colors, deltas, first, background)
        return Seen(asked, deltas, first, image)

    def colors(self, rays: Rays, background: Color) -> Any:
        """See `Field`."""
        return self._look(rays, lambda *shape: np.full(shape, 0.5), background)["fine"].image.rgb


class NerfSmall(Nerf):
    """NeRF with networks that two cores train within an hour."""

    name = "nerf-small"
    depth, width = 4, 64
    coarse, fine = 32, 64
    """Half of the paper's, for images of 100 x 100 pixels."""
    rays = 256
    rate, rate_final = 8e-3, 4e-4
    """Sixteen times the paper's at the start, for networks with a quarter of the width and few steps."""
    iterations = 3500
