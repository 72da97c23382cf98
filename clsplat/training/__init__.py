"""Training: algorithm 1 of Kerbl et al. 2023.

Belongs here: the loop and its step, the state and its checkpoints, the optimiser, the first Gaussians, densification
(`densify`), the search for the number of Gaussians (`autosize`) and whole configurations (`presets`). Does not belong
here: loading photos, evaluation, and anything that writes a scene.

Your own training loops can import what they need from here.
"""

from clsplat.training.densify import STRATEGIES, Strategy
from clsplat.training.initialize import initialize
from clsplat.training.loop import train
from clsplat.training.optimizer import Adam
from clsplat.training.preparation import prepare

__all__ = ["STRATEGIES", "Adam", "Strategy", "initialize", "prepare", "train"]
