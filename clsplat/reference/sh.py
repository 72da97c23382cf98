"""Real spherical harmonics up to degree 3 as polynomials; twin of cl/sh.h.

Each basis function is a sum of terms (coefficient, powers of x, y, z), which yield its value and its derivatives.
Normalisation and signs follow Sloan 2008, "Stupid Spherical Harmonics Tricks", appendix A2.
"""

from math import pi, sqrt

import numpy as np
from numpy.typing import NDArray

Term = tuple[float, tuple[int, int, int]]


def _polynomial(scale: float, *terms: Term) -> list[Term]:
    return [(scale * c, powers) for c, powers in terms]


BASIS: list[list[Term]] = [
    _polynomial(1 / (2 * sqrt(pi)), (1, (0, 0, 0))),
    _polynomial(-sqrt(3 / (4 * pi)), (1, (0, 1, 0))),
    _polynomial(sqrt(3 / (4 * pi)), (1, (0, 0, 1))),
    _polynomial(-sqrt(3 / (4 * pi)), (1, (1, 0, 0))),
    _polynomial(sqrt(15 / (4 * pi)), (1, (1, 1, 0))),
    _polynomial(-sqrt(15 / (4 * pi)), (1, (0, 1, 1))),
    _polynomial(sqrt(5 / (16 * pi)), (2, (0, 0, 2)), (-1, (2, 0, 0)), (-1, (0, 2, 0))),
    _polynomial(-sqrt(15 / (4 * pi)), (1, (1, 0, 1))),
    _polynomial(sqrt(15 / (16 * pi)), (1, (2, 0, 0)), (-1, (0, 2, 0))),
    _polynomial(-sqrt(35 / (32 * pi)), (3, (2, 1, 0)), (-1, (0, 3, 0))),
    _polynomial(sqrt(105 / (4 * pi)), (1, (1, 1, 1))),
    _polynomial(-sqrt(21 / (32 * pi)), (4, (0, 1, 2)), (-1, (2, 1, 0)), (-1, (0, 3, 0))),
    _polynomial(sqrt(7 / (16 * pi)), (2, (0, 0, 3)), (-3, (2, 0, 1)), (-3, (0, 2, 1))),
    _polynomial(-sqrt(21 / (32 * pi)), (4, (1, 0, 2)), (-1, (3, 0, 0)), (-1, (1, 2, 0))),
    _polynomial(sqrt(105 / (16 * pi)), (1, (2, 0, 1)), (-1, (0, 2, 1))),
    _polynomial(-sqrt(35 / (32 * pi)), (1, (3, 0, 0)), (-3, (1, 2, 0))),
]


def sh_basis(directions: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Values of the basis functions at unit vectors (N, 3), (N, (degree + 1)^2)."""
    polynomials = BASIS[: (degree + 1) ** 2]
    return np.stack([sum(c * np.prod(directions**e, axis=1) for c, e in terms) for terms in polynomials], axis=1)


def sh_basis_jacobian(directions: NDArray[np.float64], degree: int) -> NDArray[np.float64]:
    """Derivatives by the components of the direction, as independent variables, (N, (degree + 1)^2, 3)."""
    result = np.zeros((len(directions), (degree + 1) ** 2, 3))
    for k, terms in enumerate(BASIS[: (degree + 1) ** 2]):
        for c, powers in terms:
            for axis in range(3):
                if powers[axis]:
                    lowered = np.array(powers) - np.eye(3, dtype=int)[axis]
                    result[:, k, axis] += c * powers[axis] * np.prod(directions**lowered, axis=1)
    return result
