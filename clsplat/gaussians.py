"""The scene's parameters: N Gaussians as five arrays, pre-activation."""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat import display
from clsplat.constants import SH_DEGREE_MAX
from clsplat.errors import InputError

Array = NDArray[Any]

# Width of a row per field; None stands for the K coefficients of the spherical harmonics.
SHAPES: dict[str, tuple[int | None, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "sh": (None, 3),
}


def sigmoid(x: Any) -> Any:
    """1/(1 + exp(-x)), without overflow."""
    e = np.exp(-np.abs(x))
    return np.where(x >= 0, 1, e) / (1 + e)


def logit(p: Any) -> Any:
    """Inverse of `sigmoid`; p in (0, 1)."""
    return np.log(p) - np.log1p(-p)


@dataclass
class Gaussians:
    """N Gaussians, parameters as they are optimised and stored.

    Parameters
    ----------
    means : (N, 3)
        Centres, in world units.
    log_scales : (N, 3)
        Natural logarithm of the standard deviations along the principal axes, in world units.
    quats : (N, 4)
        Orientation as quaternions wxyz; normalised where they are used.
    logit_opacities : (N,)
        Logit of the opacity.
    sh : (N, K, 3)
        Spherical-harmonics coefficients of RGB, K = (degree + 1)^2, degree 0 to 3.

    Notes
    -----
    The arrays are NumPy float32 on the host. The same container carries device arrays between the kernels'
    launches, and gradients with respect to each field.
    """

    means: Array
    log_scales: Array
    quats: Array
    logit_opacities: Array
    sh: Array

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def scales(self) -> Array:
        """Standard deviations, (N, 3), in world units."""
        return np.exp(self.log_scales)

    @property
    def opacities(self) -> Array:
        """Opacities in (0, 1), (N,)."""
        return sigmoid(self.logit_opacities)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return round(self.sh.shape[1] ** 0.5) - 1

    def arrays(self) -> dict[str, Array]:
        """The fields by name, in their order."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    def _repr_html_(self) -> str:
        title = f"{len(self):,} Gaussian{'s' * (len(self) != 1)}"
        if not isinstance(self.means, np.ndarray):
            return display.facts(title, {"arrays": "on the device"})
        rows = {"spherical harmonics": f"degree {self.sh_degree}"}
        finite = np.logical_and.reduce([np.isfinite(a).all(tuple(range(1, a.ndim))) for a in self.arrays().values()])
        rows["memory"] = f"{sum(a.nbytes for a in self.arrays().values()) / 1e6:.3g} MB of {self.means.dtype}"
        if not finite.all():
            rows["not finite"] = f"{(~finite).sum():,} of them hold NaN or infinity"
        if not finite.any():
            return display.facts(title, rows)
        shown = self.take(finite)
        first, middle, last = np.percentile(shown.means, [1, 50, 99], axis=0)
        rows |= {"middle": display.numbers(middle), "98 % from": display.numbers(first), "to": display.numbers(last)}
        sizes = shown.log_scales.mean(axis=1) / np.log(10)
        low, high = np.percentile(sizes, [0.5, 99.5])
        return display.facts(
            title,
            rows,
            display.histogram(shown.opacities, 0, 1, "opacity"),
            display.histogram(sizes, low - 0.1, high + 0.1, "size: log10 of the mean standard deviation"),
        )

    def validate(self) -> "Gaussians":
        """Check shapes and dtypes; return self.

        Raises
        ------
        InputError
            Names the first field whose shape does not fit the others or that is not a float array.
        """
        n = len(self)
        for name, tail in SHAPES.items():
            array = getattr(self, name)
            expected = (n, *(array.shape[1] if w is None and array.ndim > 1 else w for w in tail))
            if array.shape != expected:
                raise InputError(f"{name}: expected shape {expected}, found {array.shape}")
            if array.dtype not in (np.float32, np.float64):
                raise InputError(f"{name}: expected float32 or float64, found {array.dtype}")
        if self.sh.shape[1] not in [(d + 1) ** 2 for d in range(SH_DEGREE_MAX + 1)]:
            raise InputError(f"sh: expected 1, 4, 9 or 16 coefficients, found {self.sh.shape[1]}")
        return self

    def astype(self, dtype: Any) -> "Gaussians":
        """Contiguous copy as float32 or float64."""
        return Gaussians(**{k: np.array(v, dtype=dtype, order="C") for k, v in self.arrays().items()})

    def take(self, rows: Array) -> "Gaussians":
        """The rows selected by an index or boolean array, as a new object."""
        return Gaussians(**{k: v[rows] for k, v in self.arrays().items()})

    @staticmethod
    def concatenate(parts: list["Gaussians"]) -> "Gaussians":
        """The rows of all parts, one after the other. Coefficients of the harmonics that some parts lack are zero."""
        most = max(part.sh.shape[1] for part in parts)
        arrays = {name: [getattr(part, name) for part in parts] for name in SHAPES}
        arrays["sh"] = [np.pad(sh, ((0, 0), (0, most - sh.shape[1]), (0, 0))) for sh in arrays["sh"]]
        return Gaussians(**{name: np.concatenate(values) for name, values in arrays.items()})
