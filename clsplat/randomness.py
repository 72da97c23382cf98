"""Counter-based random numbers: a stream per seed, purpose and index, whatever was drawn before.

A resumed run therefore needs no generator's state (Philox: Salmon et al. 2011, doi:10.1145/2063384.2063405).
"""

import numpy as np

PURPOSES = (
    "initial points",
    "order of the views",
    "positions of split Gaussians",
    "points of the start",
    "sources of relocated Gaussians",
    "sources of new Gaussians",
    "surveyed views",
    "backgrounds",
    "points between points",
)


def stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """Generator for one use: `purpose` is one of `PURPOSES`, `index` counts its uses (an epoch, an iteration)."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, PURPOSES.index(purpose), index]))
