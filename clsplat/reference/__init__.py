"""The stages in float64 NumPy: readable mathematics, the oracle of the tests, and a renderer without OpenCL.

This module implements `clsplat.stages.Stages`. Belongs here: one module per stage with its equations, and what
several stages share (lenses, spherical harmonics). Does not belong here: the algorithms that make a stage fast.
"""

from clsplat.reference.absgrad import absgrad
from clsplat.reference.adam import adam_array, adam_step
from clsplat.reference.bin import bin_splats
from clsplat.reference.composite import composite_bwd, composite_fwd
from clsplat.reference.count import count_pairs
from clsplat.reference.disparity import disparity_bwd, disparity_fwd, disparity_grad, disparity_loss
from clsplat.reference.dropout import dropout_bwd, dropout_fwd
from clsplat.reference.encode import encode_join, encode_join_bwd, encode_points
from clsplat.reference.exposure import exposure_bwd, exposure_fwd
from clsplat.reference.filter import filter_bwd, filter_fwd, pixel_sizes
from clsplat.reference.finite import count_not_finite
from clsplat.reference.frustums import frustums_encode
from clsplat.reference.hashgrid import hashgrid_bwd, hashgrid_fwd
from clsplat.reference.heads import (
    heads_bwd,
    heads_fwd,
    heads_join,
    heads_join_bwd,
    heads_sh_bwd,
    heads_sh_fwd,
    heads_soft_bwd,
    heads_soft_fwd,
)
from clsplat.reference.histograms import histograms_distortion, histograms_interlevel
from clsplat.reference.intervals import intervals_along, intervals_resample
from clsplat.reference.loss import l1_ssim
from clsplat.reference.march import march
from clsplat.reference.median import median_splats
from clsplat.reference.mlp import mlp_bwd, mlp_fwd
from clsplat.reference.noise import add_noise
from clsplat.reference.observe import add_column, observe
from clsplat.reference.project import join_rows, project_bwd, project_bwd_adam, project_disparities, project_fwd
from clsplat.reference.rays import rays_bwd, rays_fwd
from clsplat.reference.removal import removal, removal_residuals, removal_sums
from clsplat.reference.scan import exclusive_scan
from clsplat.reference.sort import argsort, argsort_segments
from clsplat.reference.spheres import spheres
from clsplat.reference.sweep import sweep_best, sweep_scores
from clsplat.reference.take import take_rows
from clsplat.reference.voxels import voxels_bwd, voxels_fwd, voxels_tv
from clsplat.reference.weights import weights_bwd, weights_fwd
