"""Launches of the kernels: the functions of `clsplat.reference` with a `clsplat.device.Device` as first argument.

Belongs here: one module per stage, which checks shapes, allocates buffers and launches kernels of ``cl/``. Does not
belong here: the mathematics (``cl/``, `clsplat.reference`), and the order of the stages (`clsplat.render`).
"""

from clsplat.ops.adam import adam_step
from clsplat.ops.bin import bin_splats
from clsplat.ops.composite import composite_bwd, composite_fwd
from clsplat.ops.count import count_pairs
from clsplat.ops.dropout import dropout_bwd, dropout_fwd
from clsplat.ops.exposure import exposure_bwd, exposure_fwd
from clsplat.ops.filter import filter_bwd, filter_fwd, pixel_sizes
from clsplat.ops.loss import l1_ssim
from clsplat.ops.noise import add_noise
from clsplat.ops.observe import observe
from clsplat.ops.project import project_bwd, project_bwd_adam, project_disparities, project_fwd
from clsplat.ops.removal import removal
from clsplat.ops.scan import exclusive_scan
from clsplat.ops.sort import argsort, argsort_segments

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
