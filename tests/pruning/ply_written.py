"""A PLY of Gaussians that is written in parts, for scenes that do not fit the memory."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.formats.ply import comments_of, table_of
from clsplat.gaussians import Gaussians


def save_ply_parts(path: Path, parts: Iterable[Gaussians], count: int, mode: Mode, offset: ArrayLike | None) -> None:
    """Write Gaussians part by part, to the bytes that `save_ply` writes for all of them.

    Parameters
    ----------
    path : Path
    parts : iterable of Gaussians
        With the same degree of spherical harmonics, and `count` Gaussians in all.
    count : int
    mode, offset
        As in `clsplat.formats.save_gaussians`.

    Raises
    ------
    InputError
        As `save_ply`.
    """
    from plyfile import PlyData, PlyElement

    with replacing(path) as out:
        for number, part in enumerate(parts):
            names, table = table_of(path, part)
            if number == 0:
                none = np.empty(0, [(name, "<f4") for name in names])
                ply = PlyData(
                    [PlyElement.describe(none, "vertex")], byte_order="<", comments=comments_of(mode, offset)
                )
                header = str(ply.header).replace("element vertex 0", f"element vertex {count}")
                out.write(f"{header}\n".encode("ascii"))
            out.write(table.tobytes())
