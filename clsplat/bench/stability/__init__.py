"""How much the method's known failures cost without their remedies and with them: `clsplat bench stability`."""

from clsplat.bench.stability import (
    coordinates,
    densities,
    gradients,
    growth,
    images,
    order,
    photos,
    popping,
    projection,
    scales,
    views,
)
from clsplat.bench.stability.experiment import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    "world-offset": coordinates.WORLD_OFFSET,
    "equal-depths": order.EQUAL_DEPTHS,
    "repeated-runs": order.REPEATED_RUNS,
    "popping": popping.POPPING,
    "poisoning": projection.POISONING,
    "needles": projection.NEEDLES,
    "effective-rank": views.EFFECTIVE_RANK,
    "jacobian": projection.JACOBIAN,
    "wide-angle": projection.WIDE_ANGLE,
    "scales": scales.SCALE,
    "exposure": photos.EXPOSURE,
    "poses": photos.POSES,
    "few-views": photos.FEW_VIEWS,
    "floaters": views.FLOATERS,
    "dark-areas": photos.DARK_AREAS,
    "constants": gradients.CONSTANTS,
    "everything-pruned": densities.ALL_PRUNED,
    "opacity-reset": growth.OPACITY_RESET,
    "blow-up": growth.BLOW_UP,
    "random-start": growth.RANDOM_START,
    "sh-extrapolation": views.EXTRAPOLATION,
    "dead-gaussians": densities.DEAD,
    "images": images.KINDS,
}
"""In the order of docs/stability.md; a line enrols an experiment in the command, the page and the tests."""
