"""Constants of the rendering model: their only home.

They feed the ``-D`` definitions of the kernels (`clsplat.device`), the float64 twins (`clsplat.reference`)
and the documentation. Sources: "paper" is Kerbl et al. 2023, doi:10.1145/3592433; "original" is the code
published with it.
"""

from math import exp, log2, radians
from typing import Literal

ALPHA_MIN = 1.0 / 255.0
"""Pairs with a smaller alpha are skipped: less than one step of an 8-bit image (original, section 6 of the paper)."""

LOG2_ALPHA_MIN = log2(ALPHA_MIN)
"""The compositing kernels compare exponents of two."""

EXPONENT_SLACK = 1e-5
"""By how much an exponent of two may exceed that of the opacity: float32 rounding where sigma is 0, no more. What
lies beyond has sigma < 0, which only an indefinite conic brings about, and is skipped (original)."""

ALPHA_MAX = 0.99
"""Alpha is clamped here so that 1/(1 - alpha) stays bounded in the backward pass (original)."""

TRANSMITTANCE_MIN = 1e-4
"""Compositing of a pixel stops before its transmittance would fall to this value or below (original)."""

BLUR = 0.3
"""Pixels squared added to the diagonal of the 2D covariance: a splat covers at least about a pixel (original)."""

COMPENSATION_MIN = 0.005
"""Floor of the opacity compensation of the antialiased mode, so that its gradient stays bounded (gsplat)."""

FILTER_VARIANCE = 0.2
"""Of the 3D filter, in squared sizes of a pixel in the photo that samples a Gaussian most finely (Mip-Splatting)."""

NEAR = 0.01
"""Depth in world units at which Gaussians are culled unless a dataset says more (gsplat; the original: 0.2)."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is evaluated inside the image enlarged by this fraction of its half width (original: the 1.3)."""

FISHEYE_ANGLE_MAX = radians(170)
"""From a fisheye's axis: around 180 degrees a point has no place in the image. Lenses are made for up to 140."""

QUAT_NORM2_MIN = 1e-8
"""Quaternions with a smaller squared norm have no direction in float32: such Gaussians are culled (Brush)."""

EXTENT_SLACK = 1e-3
"""Added to ln(opacity/ALPHA_MIN) in extents and tile tests only. The per-pixel test decides what is drawn;
the slack keeps float32 rounding of an extent from deciding first, so that tilings agree. It costs 0.02 % of
the area at opacity 1."""

TILE: Literal[8, 16] = 16
"""Edge of a tile in pixels: one row is one float16 vector of the CPU compositor and 16x16 work-items are a
work-group that every GPU accepts."""

SH_DEGREE_MAX = 3
"""Highest degree of the spherical harmonics (paper, section 7.1)."""

SH_C0 = 0.28209479177387814
"""Y_0^0 = 1/(2 sqrt(pi)): colour = 0.5 + SH_C0 * sh[0]."""

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
"""Window, its standard deviation in pixels and the stabilisers for images in [0, 1]: Wang et al. 2004,
doi:10.1109/TIP.2003.819861. Borders are padded with zeros, as in the original's training loss."""

_WINDOW = [exp(-0.5 * (i - SSIM_WINDOW // 2) ** 2 / SSIM_SIGMA**2) for i in range(SSIM_WINDOW)]
SSIM_TAPS = tuple(w / sum(_WINDOW) for w in _WINDOW)
"""Weights of the window along one axis, of sum 1."""
