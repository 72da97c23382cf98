"""A .csv table of Gaussians, which is written: for spreadsheets, pandas and other programs that know no splats.

A row per Gaussian, with the columns of a PLY of the original implementation without normals (`clsplat.formats.ply`),
pre-activation, and a line with their names first.
"""

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.formats.ply import NORMALS, table_of
from clsplat.formats.quantisation import warn_lost
from clsplat.gaussians import Gaussians


def save_csv(path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None) -> None:
    """Write Gaussians as a .csv file, in their order; the text has the precision of float32.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`. The mode and the offset are lost with a warning.

    Raises
    ------
    InputError
        If there is no Gaussian, a value is not finite as float32, or the file cannot be written.
    """
    names, table = table_of(path, gaussians)
    warn_lost(path, mode, offset)
    kept = [k for k, name in enumerate(names) if name not in NORMALS]
    with replacing(path) as out:
        out.write((",".join(names[k] for k in kept) + "\n").encode())
        np.savetxt(out, table[:, kept], "%.9g", ",")
