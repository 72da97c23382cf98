"""The table of the experiments on real scenes, and the table of all experiments as docs/stability.md shows them."""

from dataclasses import replace
from functools import partial
from pathlib import Path

from dead_gaussians import DEAD
from needles_and_floaters import EFFECTIVE_RANK, FLOATERS, OUTERMOST
from other_scales import OTHER_SCALES
from random_start import RANDOM_START
from real_photos import EXPOSURE, FEW_VIEWS, POSES

from clsplat.bench.stability import EXPERIMENTS
from clsplat.bench.stability.experiment import Experiment

SCENE_EXPERIMENTS: dict[str, Experiment] = {
    "effective-rank": EFFECTIVE_RANK,
    "scales": OTHER_SCALES,
    "exposure": EXPOSURE,
    "poses": POSES,
    "few-views": FEW_VIEWS,
    "floaters": FLOATERS,
    "outermost": OUTERMOST,
    "random-start": RANDOM_START,
    "dead-gaussians": DEAD,
}
"""Experiments whose `measure` takes the folder of the real scenes in addition to the device."""

ORDER = (
    *("world-offset", "equal-depths", "repeated-runs", "popping", "poisoning", "needles", "effective-rank"),
    *(
        "jacobian",
        "wide-angle",
        "scales",
        "exposure",
        "poses",
        "few-views",
        "floaters",
        "outermost",
        "dark-areas",
        "constants",
    ),
    *("everything-pruned", "opacity-reset", "blow-up", "random-start", "sh-extrapolation", "dead-gaussians"),
    "images",
    "focal-length",
    "moving-object",
)
"""Names of the experiments in the order of docs/stability.md."""

ALL_EXPERIMENTS: dict[str, Experiment] = {name: (EXPERIMENTS | SCENE_EXPERIMENTS)[name] for name in ORDER}
"""The packaged experiments and those on real scenes."""


def experiments_on(data: Path) -> dict[str, Experiment]:
    """Bind the experiments on real scenes to the folder of the scenes, so that they take the device alone."""
    return {name: replace(e, measure=partial(e.measure, data=data)) for name, e in SCENE_EXPERIMENTS.items()}
