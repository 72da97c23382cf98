"""The radial function of fisheyes with four coefficients (Kannala and Brandt 2006), and its inverse."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def fisheye_radius(angle: ArrayLike, distortion: tuple[float, ...]) -> NDArray[np.float64]:
    """Compute theta_d from theta, in radians."""
    theta = np.asarray(angle, dtype=np.float64)
    return np.asarray(theta * np.polyval([*reversed(distortion), 1.0], theta**2))


def fisheye_angle(
    radius: NDArray[np.float64] | np.float64, distortion: tuple[float, ...], most: float
) -> NDArray[np.float64]:
    """Compute theta from theta_d by bisection between 0 and `most`, in which range the radius grows."""
    low = np.zeros(np.shape(radius))
    high = np.full(np.shape(radius), most)
    for _ in range(53):  # one bit of float64 per step
        middle = 0.5 * (low + high)
        below = fisheye_radius(middle, distortion) < radius
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high
