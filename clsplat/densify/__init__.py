"""Densification strategies: one file and one line each.

A strategy is a class with the interface of `clsplat.densify.strategy.Strategy`; `clsplat.train` and the tests know
strategies only through this table.
"""

from clsplat.densify.adc import Adc
from clsplat.densify.error import ErrorGuided
from clsplat.densify.mcmc import Mcmc
from clsplat.densify.strategy import Contributions, Edit, Strategy, Survey

STRATEGIES: dict[str, type[Strategy]] = {
    "adc": Adc,
    "mcmc": Mcmc,
    "error": ErrorGuided,
}

__all__ = ["STRATEGIES", "Contributions", "Edit", "Strategy", "Survey"]
