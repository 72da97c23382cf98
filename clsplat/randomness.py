"""Counter-based random numbers: a stream for each seed, purpose and index, independent of all earlier draws.

A checkpoint therefore stores no state of a generator (Philox: Salmon et al. 2011, doi:10.1145/2063384.2063405).
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
    "parameters of a field",
    "pixels of a batch",
    "offsets of samples",
    "points of the grid",
    "dense points",
    "points of blocks",
    "points of a hull",
)
"""Uses of random numbers. The index is part of the stream: new purposes are added at the end."""


def stream(seed: int, purpose: str, index: int = 0) -> np.random.Generator:
    """Make the generator for one use: `purpose` is one of `PURPOSES`, `index` counts its uses, such as iterations."""
    return np.random.Generator(np.random.Philox(key=seed, counter=[0, 0, PURPOSES.index(purpose), index]))
