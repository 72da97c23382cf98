"""The .usda of OpenUSD (text) with a prim ParticleField3DGaussianSplat, which is written.

OpenUSD 26.03 and later have this schema. Positions, orientations (wxyz), scales (no logarithms), opacities (0 to 1)
and coefficients of the spherical harmonics are arrays; the coefficients of a Gaussian follow each other. The axes of
the stage are right, up, back; those of a PLY are right, down, forward.
Source: the user guide of the schemas, https://openusd.org/release/user_guides/schemas/usdVol/ParticleField.html.
"""

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.atomic import replacing
from clsplat.config import Mode
from clsplat.errors import InputError
from clsplat.formats.axes import RIGHT_UP_BACK, turned
from clsplat.formats.quantisation import checked, warn_lost
from clsplat.gaussians import Gaussians

Array = NDArray[Any]

ROWS = 1 << 14
"""Number of rows that become text at once, which bounds the memory."""

REACH = 3.0
"""Standard deviations that the extent of the prim covers, as the schema's kernel is cut off."""

HEAD = """#usda 1.0
(
    defaultPrim = "Gaussians"
    metersPerUnit = 1
    upAxis = "Y"
)

def ParticleField3DGaussianSplat "Gaussians"
{
"""


def save_usda(
    path: str | Path, gaussians: Gaussians, mode: Mode = "classic", offset: ArrayLike | None = None
) -> None:
    """Write Gaussians as a .usda file, in their order; the text has the precision of float32.

    Parameters
    ----------
    path, gaussians, mode, offset
        As in `clsplat.formats.save_gaussians`. The mode and the offset are lost with a warning.

    Raises
    ------
    InputError
        If there is no Gaussian, a value or scale is not finite as float32, or the file cannot be written.
    """
    g = turned(checked(path, gaussians), RIGHT_UP_BACK)
    warn_lost(path, mode, offset)
    with np.errstate(over="ignore"):
        scales = g.scales
    if not np.isfinite(scales).all():
        raise InputError(f"{path}: expected scales that float32 can hold, found log_scales = {g.log_scales.max()}")
    reach = REACH * scales.max(axis=1, keepdims=True).astype(np.float64)
    extent = np.stack([(g.means - reach).min(axis=0), (g.means + reach).max(axis=0)])
    columns = {
        "float3[] extent": extent,
        "point3f[] positions": g.means,
        "quatf[] orientations": g.quats,
        "float3[] scales": scales,
        "float[] opacities": g.opacities[:, None],
        "float3[] radiance:sphericalHarmonicsCoefficients": g.sh.reshape(-1, 3),
    }
    with replacing(path) as out:
        out.write(HEAD.encode())
        out.write(f"    uniform int radiance:sphericalHarmonicsDegree = {g.sh_degree}\n".encode())
        for name, column in columns.items():
            out.write(f"    {name} = [".encode())
            _write_rows(out, column)
            out.write(b"]\n")
        out.write(b"}\n")


def _write_rows(out: BinaryIO, rows: Array) -> None:
    """Write numbers (N, D) as tuples, or as plain numbers for D = 1, with the digits that float32 needs."""
    number = ", ".join(["%.9g"] * rows.shape[1])
    form = f"({number})" if rows.shape[1] > 1 else number
    for first in range(0, len(rows), ROWS):
        part = rows[first : first + ROWS]
        text = ", ".join([form] * len(part)) % tuple(part.ravel().tolist())
        out.write((", " if first else "").encode() + text.encode())
