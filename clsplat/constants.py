"""Constants of the rendering model.

No other module defines them. They feed the ``-D`` definitions of the kernels (`clsplat.device`), the float64 twins
(`clsplat.reference`) and the documentation. Sources: "paper" is Kerbl et al. 2023, doi:10.1145/3592433; "original" is
the code published with it.
"""

from math import exp, log2, radians

ALPHA_MIN = 1.0 / 255.0
"""Smallest alpha of a pair of splat and pixel that is drawn: one step of an 8-bit image (original, section 6 of the
paper)."""

LOG2_ALPHA_MIN = log2(ALPHA_MIN)
"""Base-2 logarithm of ALPHA_MIN. The compositing kernels compare exponents of two."""

EXPONENT_SLACK = 1e-5
"""Largest excess of alpha's exponent of two over that of the opacity, along rays. It covers the rounding of float32
at sigma = 0. A larger excess means sigma < 0, which only an indefinite conic yields; such pairs are skipped
(original)."""

ALPHA_MAX = 0.99
"""Largest alpha. It is clamped so that 1/(1 - alpha) stays bounded in the backward pass (original)."""

TRANSMITTANCE_MIN = 1e-4
"""Lower bound of a pixel's transmittance. Compositing stops before it would fall to this value or below
(original)."""

BLUR = 0.3
"""Variance added to the diagonal of the 2D covariance, px^2, so that a splat covers at least about a pixel
(original)."""

COMPENSATION_MIN = 0.005
"""Smallest opacity compensation of the mode "antialiased". It keeps the gradient bounded (gsplat)."""

FILTER_VARIANCE = 0.2
"""Variance of the 3D filter, in units of the squared size of a pixel at the Gaussian, in the photo that samples it
most finely (Mip-Splatting)."""

NEAR = 0.01
"""Depth of the near plane, in front of which Gaussians are culled, world units, where nothing is known of the scene
(gsplat; original: 0.2)."""

NEAR_EXTENTS = 0.0025
"""Depth of the near plane where no points tell it: in extents of the scene, or in `default_near` in median distances
of the Gaussians from their median. For NeRF-synthetic scenes it is `NEAR` within a tenth."""

FRUSTUM_MARGIN = 0.3
"""Margin around the image to which the slopes x/z and y/z of the Jacobian are clamped, as a fraction of half the
image's width or height (original, as a factor of 1.3)."""

FISHEYE_ANGLE_MAX = radians(170)
"""Largest angle from the axis of a fisheye camera, radians. Near 180 degrees a point has no position in the image.
Lenses reach up to 140 degrees."""

QUAT_NORM2_MIN = 1e-8
"""Smallest squared norm of a quaternion. Below it, the direction is lost in float32, and the Gaussian is culled
(Brush)."""

EXTENT_SLACK = 1e-3
"""Slack added to ln(opacity/ALPHA_MIN) in extents and tile tests only. With it, the test per pixel decides what is
drawn, not the rounding of an extent in float32, so that all tile sizes give the same image. It enlarges the area by
0.02 % at opacity 1."""

TILE = 16
"""Edge of a tile, px, on CPUs with vectors of 8 numbers, which gain nothing from larger tiles, and where each pixel
sorts its splats."""

GPU_TILE = 8
"""Edge of a tile on GPUs, px. Each work-item takes all splats of its tile, so that small tiles save work where splats
are small (measured: docs/gpu.md)."""

SEGMENT = 64
"""Splats of a tile's list that a work-group of a GPU's backward pass composites. Lists that are longer are shared by
several groups, for each of which the forward pass saves 4 (1 + C) bytes per pixel of the tile (measured:
docs/gpu.md)."""

WIDE_TILE = 32
"""Edge of a tile on CPUs with vectors of 16 numbers, px: fewer lists, which such CPUs process faster (measured:
docs/stages/composite.md)."""

SH_DEGREE_MAX = 3
"""Highest degree of the spherical harmonics (paper, section 7.1)."""

SH_C0 = 0.28209479177387814
"""Value of the basis function of degree 0, Y_0^0 = 1/(2 sqrt(pi)): colour = 0.5 + SH_C0 * sh[0]."""

SSIM_WINDOW = 11
SSIM_SIGMA = 1.5
SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
"""Edge of SSIM's window, px, its standard deviation, px, and the stabilisers for images in [0, 1] (Wang et al. 2004,
doi:10.1109/TIP.2003.819861). Borders are padded with zeros, as in the training loss of the original."""

_WINDOW = [exp(-0.5 * (i - SSIM_WINDOW // 2) ** 2 / SSIM_SIGMA**2) for i in range(SSIM_WINDOW)]
SSIM_TAPS = tuple(w / sum(_WINDOW) for w in _WINDOW)
"""Weights of SSIM's window along one axis. Their sum is 1."""

SWEEP_RADIUS = 2
"""Half of the window in which the stage sweep compares photos, px: 5x5 pixels, as small as noise allows, since a
window across an edge of depth has the depth of neither side."""

SWEEP_PLANES = 4
"""Planes on which the stage sweep resamples photos before it compares them: few enough that they stay in a cache."""

SWEEP_VARIANCE_MIN = (3 / 255) ** 2
"""Least variance of grey values in such a window: 3 levels of 8 bits, the noise of a photo. Flat windows are alike at
all depths."""
