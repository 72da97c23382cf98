"""Densification strategies: one file and one line each.

A strategy is a class with the interface of `clsplat.training.densify.strategy.Strategy`; training and the tests know
strategies only through the table `STRATEGIES`. Belongs here: when and where Gaussians are added and removed. Does not
belong here: how many there should be (`clsplat.training.autosize`) and what the optimiser does with new rows.
"""

from clsplat.training.densify.adc import Adc
from clsplat.training.densify.error_guided import ErrorGuided
from clsplat.training.densify.mcmc import Mcmc
from clsplat.training.densify.strategy import Contributions, Edit, Strategy, Survey

STRATEGIES: dict[str, type[Strategy]] = {
    "adc": Adc,
    "mcmc": Mcmc,
    "error": ErrorGuided,
}

__all__ = ["STRATEGIES", "Contributions", "Edit", "Strategy", "Survey"]
