"""Parameters learned per training photo, with an optimiser (Adam) of their own on the host."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config import OptimConfig

Array = NDArray[Any]


@dataclass
class PerPhoto:
    """Parameters of V photos.

    names: names of the photos; values (V, ...): the parameters; first, second (V, ...): Adam's moments of the
    gradients; steps (V,): number of updates of each photo's parameters, by which its moments are corrected.
    """

    names: list[str]
    values: Array
    first: Array
    second: Array
    steps: Array

    @classmethod
    def start(cls, names: list[str], value: Array, shape: tuple[int, ...]) -> "PerPhoto":
        """Parameters with the same value for all photos; `shape` is that of a photo's gradient."""
        v = len(names)
        values = np.repeat(np.asarray(value, np.float64)[None], v, axis=0)
        return cls(names, values, np.zeros((v, *shape)), np.zeros((v, *shape)), np.zeros(v, np.int64))

    def of(self, name: str) -> Array:
        """A photo's parameters, a view of them."""
        values: Array = self.values[self.names.index(name)]
        return values

    def step(self, name: str, gradient: Array, rate: Any, config: OptimConfig) -> Array:
        """Step of Adam (Kingma and Ba 2015, algorithm 1) for a photo, which the caller adds; changes the moments."""
        i = self.names.index(name)
        self.steps[i] += 1
        self.first[i] += (1 - config.beta1) * (gradient - self.first[i])
        self.second[i] += (1 - config.beta2) * (gradient**2 - self.second[i])
        mean = self.first[i] / (1 - config.beta1 ** self.steps[i])
        square = self.second[i] / (1 - config.beta2 ** self.steps[i])
        step: Array = -rate * mean / (np.sqrt(square) + config.eps)
        return step

    def arrays(self) -> dict[str, Array]:
        """The fields as arrays, for a checkpoint."""
        return {**vars(self), "names": np.array(self.names)}

    @classmethod
    def restored(cls, arrays: dict[str, Array], start: "Callable[[list[str]], PerPhoto]") -> "PerPhoto":
        """Parameters from the arrays that `arrays` returned; `start` makes those of their kind.

        Raises
        ------
        KeyError, ValueError
            If an array is missing, or has another type or shape; if values are not finite or steps negative.
        """
        names = [str(name) for name in arrays["names"]]
        fresh = start(names).arrays()
        for name in ("values", "first", "second", "steps"):
            array = arrays[name]
            if (array.dtype, array.shape) != (fresh[name].dtype, fresh[name].shape):
                raise ValueError(f"{name} of type {array.dtype} and shape {array.shape} for {len(names)} photos")
        if not np.isfinite(arrays["values"]).all() or (arrays["steps"] < 0).any():
            raise ValueError("values that are not finite, or negative steps")
        return cls(names, *(arrays[name] for name in ("values", "first", "second", "steps")))
