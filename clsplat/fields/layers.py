"""Networks of fields: their parameters, and the network that NeRF and Mip-NeRF 360 ask at each sample."""

from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from clsplat.field_stages import encoded_width
from clsplat.fields.field import Array, Field
from clsplat.stages import AdamStep, Stages

if TYPE_CHECKING:
    from clsplat.device import Device

COLOR_OUTPUTS = 16
"""Width of the last layer of colours: three, padded."""

VIEW_LEVELS = 4
"""Frequencies of directions (Mildenhall et al. 2020, section 5.1)."""


class Parameters:
    """An array of parameters with Adam's moments, on the device."""

    def __init__(self, device: "Device", values: Array):
        self.values = device.upload("parameters", values)
        self.first, self.second = (device.upload("moments", np.zeros(values.shape)) for _ in range(2))


def first_weights(rng: np.random.Generator, widths: tuple[int, ...]) -> Array:
    """First weights, uniform with the variance 2 / (inputs + outputs) of a layer (Glorot and Bengio 2010)."""
    limits = [(6 / (a + b)) ** 0.5 for a, b in pairwise(widths)]
    sizes = [a * b for a, b in pairwise(widths)]
    return np.concatenate([rng.uniform(-limit, limit, size) for limit, size in zip(limits, sizes, strict=True)])


def moments(parameters: dict[str, Parameters]) -> dict[str, Array]:
    """Arrays of Adam's moments, for a checkpoint."""
    arrays = {f"{name}.first": p.first.get() for name, p in parameters.items()}
    return arrays | {f"{name}.second": p.second.get() for name, p in parameters.items()}


def restore_parameters(parameters: dict[str, Parameters], arrays: dict[str, Array], real: Any) -> None:
    """Set parameters and, if they are there, their moments."""
    for name, p in parameters.items():
        p.values.set(arrays[name].astype(real).reshape(p.values.shape))
        if f"{name}.first" in arrays:
            p.first.set(arrays[f"{name}.first"].astype(real).reshape(p.values.shape))
            p.second.set(arrays[f"{name}.second"].astype(real).reshape(p.values.shape))


class NetworkField(Field):
    """A field all of whose parameters are `parameters`: networks, by name."""

    parameters: dict[str, Parameters]

    def model(self) -> dict[str, Array]:
        """See `Field`."""
        return {name: p.values.get() for name, p in self.parameters.items()}

    def optimiser(self) -> dict[str, Array]:
        """See `Field`."""
        return moments(self.parameters)

    def restore(self, arrays: dict[str, Array]) -> None:
        """See `Field`."""
        restore_parameters(self.parameters, arrays, self.device.real)

    def finish(self) -> None:
        """Nothing is rounded."""


class Asked(NamedTuple):
    """Results of a network at samples, all on the device, for the gradients."""

    encoded: Any
    early: Any
    early_hidden: Any
    joined: Any
    features: Any
    late_hidden: Any
    seen: Any
    outputs: Any
    color_hidden: Any
    sigmas: Any
    colors: Any


class ViewNetwork:
    """A network of density and colour, whose middle layer sees the point again (Mildenhall et al. 2020, figure 7).

    Half of the layers and one come first; the next sees the encoding of the point again. The last results are
    features without a maximum; the first of them makes the density, where the paper has an output of its own. They
    and the direction go through one layer of half the width to the colour.

    Parameters
    ----------
    inputs : int
        Width of the encoding of a point.
    depth, width : int
        Number and width of the layers.
    features : int
        Number of features, of which the colour is made.
    colors : int
        Width of the layer of colours.
    """

    def __init__(self, inputs: int, depth: int, width: int, features: int, colors: int):
        before = depth // 2 + 1
        self.widths = {
            "early": (inputs, *[width] * before),
            "late": (width + inputs, *[width] * (depth - before), features),
            "color": (features + encoded_width(VIEW_LEVELS), colors, COLOR_OUTPUTS),
        }

    def parameters(self, device: "Device", rng: np.random.Generator, name: str) -> dict[str, Parameters]:
        """First parameters, by their names, which begin with `name`."""
        return {f"{name}.{part}": Parameters(device, first_weights(rng, w)) for part, w in self.widths.items()}

    def ask(self, stages: Stages, weights: dict[str, Any], encoded: Any, views: Any, density_scale: float) -> Asked:
        """Densities and colours at samples.

        Parameters
        ----------
        stages : Stages
        weights : dict
            By the name of the part: early, late, color.
        encoded : (S, inputs) real
        views : (R, encoded_width(VIEW_LEVELS)) real
            Encodings of the directions of rays with S / R samples each.
        density_scale : float
        """
        early, early_hidden = stages.mlp_fwd(encoded, weights["early"], self.widths["early"])
        joined = stages.encode_join(early, encoded, True)
        features, late_hidden = stages.mlp_fwd(joined, weights["late"], self.widths["late"])
        seen = stages.encode_join(features, views, False)
        outputs, color_hidden = stages.mlp_fwd(seen, weights["color"], self.widths["color"])
        sigmas, colors = stages.heads_soft_fwd(features, outputs, density_scale)
        hidden = joined, features, late_hidden, seen, outputs, color_hidden
        return Asked(encoded, early, early_hidden, *hidden, sigmas, colors)

    def gradients(
        self,
        stages: Stages,
        weights: dict[str, Any],
        asked: Asked,
        density_scale: float,
        v_sigmas: Any,
        v_colors: Any,
    ) -> dict[str, Any]:
        """Gradients of all weights, by the name of the part."""
        widths = self.widths
        v_outputs = stages.heads_bwd(asked.colors, v_colors)
        features, width = asked.features.shape[1], asked.early.shape[1]
        # Of the joined inputs, only the features have a gradient that is needed: they come first.
        v_seen, v_color = stages.mlp_bwd(
            asked.seen, weights["color"], widths["color"], asked.color_hidden, v_outputs, features
        )
        v_features = stages.encode_join_bwd(v_seen, asked.features, False)
        stages.heads_soft_bwd(asked.features, density_scale, v_sigmas, v_features)
        v_joined, v_late = stages.mlp_bwd(
            asked.joined, weights["late"], widths["late"], asked.late_hidden, v_features, width
        )
        v_early = stages.encode_join_bwd(v_joined, asked.early, True)
        last = stages.mlp_bwd(asked.encoded, weights["early"], widths["early"], asked.early_hidden, v_early, 0)
        return {"early": last[1], "late": v_late, "color": v_color}


def descend(
    stages: Stages, parameters: dict[str, Parameters], gradients: dict[str, Any], rate: float, step: AdamStep
) -> None:
    """Take a step of Adam with all parameters, whose gradients have their names."""
    for name, gradient in gradients.items():
        p = parameters[name]
        stages.adam_array(p.values, gradient, p.first, p.second, rate, step)
