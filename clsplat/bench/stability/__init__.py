"""How much the method's known failures cost without their remedies and with them: `clsplat bench stability`."""

from clsplat.bench.stability import (
    coordinates,
    densities,
    gradients,
    images,
    order,
    photos,
    popping,
    projection,
    scales,
)
from clsplat.bench.stability.experiment import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    "world-offset": coordinates.WORLD_OFFSET,
    "equal-depths": order.EQUAL_DEPTHS,
    "repeated-runs": order.REPEATED_RUNS,
    "popping": popping.POPPING,
    "poisoning": projection.POISONING,
    "needles": projection.NEEDLES,
    "wide-angle": projection.WIDE_ANGLE,
    "scales": scales.SCALE,
    "exposure": photos.EXPOSURE,
    "poses": photos.POSES,
    "few-views": photos.FEW_VIEWS,
    "dark-areas": photos.DARK_AREAS,
    "constants": gradients.CONSTANTS,
    "everything-pruned": densities.ALL_PRUNED,
    "dead-gaussians": densities.DEAD,
    "images": images.KINDS,
}
"""In the order of docs/stability.md; a line enrols an experiment in the command, the page and the tests."""
