"""Experiments on the known failures of the method, for `clsplat bench stability`.

Belongs here: experiments that need only a device, each without its remedy and with it, how they are run, and the
report. Does not belong here: experiments that train on real scenes (``tests/stability/scenes``), and the remedies.
"""

from clsplat.bench.stability import (
    coordinates,
    dark_areas,
    everything_pruned,
    gradients,
    growth,
    images,
    order,
    popping,
    projection,
    sh_extrapolation,
    wrong_data,
)
from clsplat.bench.stability.experiment import Experiment

EXPERIMENTS: dict[str, Experiment] = {
    "world-offset": coordinates.WORLD_OFFSET,
    "equal-depths": order.EQUAL_DEPTHS,
    "repeated-runs": order.REPEATED_RUNS,
    "popping": popping.POPPING,
    "poisoning": projection.POISONING,
    "needles": projection.NEEDLES,
    "jacobian": projection.JACOBIAN,
    "wide-angle": projection.WIDE_ANGLE,
    "dark-areas": dark_areas.DARK_AREAS,
    "constants": gradients.CONSTANTS,
    "everything-pruned": everything_pruned.ALL_PRUNED,
    "opacity-reset": growth.OPACITY_RESET,
    "blow-up": growth.BLOW_UP,
    "sh-extrapolation": sh_extrapolation.EXTRAPOLATION,
    "images": images.KINDS,
    "focal-length": wrong_data.FOCAL_LENGTH,
    "moving-object": wrong_data.MOVING,
}
"""Experiments by name. One line here adds an experiment to the command and its report."""
