"""The stages in float64 NumPy: readable mathematics, the oracle of the tests, and a renderer without OpenCL.

This module implements `clsplat.stages.Stages`. Belongs here: one module per stage with its equations, and what
several stages share (lenses, spherical harmonics). Does not belong here: the algorithms that make a stage fast.
"""

from clsplat.reference.adam import adam_step
from clsplat.reference.bin import bin_splats
from clsplat.reference.composite import composite_bwd, composite_fwd
from clsplat.reference.count import count_pairs
from clsplat.reference.dropout import dropout_bwd, dropout_fwd
from clsplat.reference.exposure import exposure_bwd, exposure_fwd
from clsplat.reference.filter import filter_bwd, filter_fwd, pixel_sizes
from clsplat.reference.finite import count_not_finite
from clsplat.reference.loss import l1_ssim
from clsplat.reference.median import median_splats
from clsplat.reference.noise import add_noise
from clsplat.reference.observe import observe
from clsplat.reference.project import project_bwd, project_bwd_adam, project_disparities, project_fwd
from clsplat.reference.removal import removal
from clsplat.reference.scan import exclusive_scan
from clsplat.reference.sort import argsort, argsort_segments
