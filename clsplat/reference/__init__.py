"""The stages in float64 NumPy: readable mathematics, the reference of the tests, and a renderer without OpenCL.

Belongs here: one module per stage that states its equations, and equations that several stages share. Does not belong
here: anything faster but harder to read than the equation, and imports other than NumPy.
"""

from clsplat.reference.adam import adam_step
from clsplat.reference.bin import bin_splats
from clsplat.reference.composite import composite_bwd, composite_fwd
from clsplat.reference.count import count_pairs
from clsplat.reference.dropout import dropout_bwd, dropout_fwd
from clsplat.reference.exposure import exposure_bwd, exposure_fwd
from clsplat.reference.filter import filter_bwd, filter_fwd, pixel_sizes
from clsplat.reference.loss import l1_ssim
from clsplat.reference.noise import add_noise
from clsplat.reference.observe import observe
from clsplat.reference.project import project_bwd, project_bwd_adam, project_disparities, project_fwd
from clsplat.reference.removal import removal
from clsplat.reference.scan import exclusive_scan
from clsplat.reference.sort import argsort, argsort_segments

__all__ = [
    "adam_step",
    "add_noise",
    "argsort",
    "argsort_segments",
    "bin_splats",
    "composite_bwd",
    "composite_fwd",
    "count_pairs",
    "dropout_bwd",
    "dropout_fwd",
    "exclusive_scan",
    "exposure_bwd",
    "exposure_fwd",
    "filter_bwd",
    "filter_fwd",
    "l1_ssim",
    "observe",
    "pixel_sizes",
    "project_bwd",
    "project_bwd_adam",
    "project_disparities",
    "project_fwd",
    "removal",
]
