"""Launches of the stages: for each function of `clsplat.stages.Stages`, one that launches its kernels on a device.

Belongs here: shapes, dtypes, buffers and the order of launches, one module per stage. Does not belong here: the
mathematics, which is in cl/ and, as NumPy, in `clsplat.reference`.
"""

from functools import partial

from clsplat.device import Device
from clsplat.ops.absgrad import absgrad
from clsplat.ops.adam import adam_array, adam_step
from clsplat.ops.bin import bin_splats
from clsplat.ops.composite import composite_bwd, composite_fwd
from clsplat.ops.count import count_pairs
from clsplat.ops.disparity import disparity_bwd, disparity_fwd, disparity_grad, disparity_loss
from clsplat.ops.dropout import dropout_bwd, dropout_fwd
from clsplat.ops.encode import encode_join, encode_join_bwd, encode_points
from clsplat.ops.exposure import exposure_bwd, exposure_fwd
from clsplat.ops.filter import filter_bwd, filter_fwd, pixel_sizes
from clsplat.ops.finite import count_not_finite
from clsplat.ops.frustums import frustums_encode
from clsplat.ops.hashgrid import hashgrid_bwd, hashgrid_fwd
from clsplat.ops.heads import (
    heads_bwd,
    heads_fwd,
    heads_join,
    heads_join_bwd,
    heads_sh_bwd,
    heads_sh_fwd,
    heads_soft_bwd,
    heads_soft_fwd,
)
from clsplat.ops.histograms import histograms_distortion, histograms_interlevel
from clsplat.ops.intervals import intervals_along, intervals_resample
from clsplat.ops.loss import l1_ssim
from clsplat.ops.march import march
from clsplat.ops.median import median_splats
from clsplat.ops.mlp import mlp_bwd, mlp_fwd
from clsplat.ops.noise import add_noise
from clsplat.ops.observe import add_column, observe
from clsplat.ops.project import join_rows, project_bwd, project_bwd_adam, project_disparities, project_fwd
from clsplat.ops.rays import rays_bwd, rays_fwd
from clsplat.ops.removal import removal, removal_residuals, removal_sums
from clsplat.ops.scan import exclusive_scan
from clsplat.ops.sort import argsort, argsort_segments
from clsplat.ops.spheres import spheres
from clsplat.ops.sweep import sweep_best, sweep_similarities
from clsplat.ops.take import take_rows
from clsplat.ops.voxels import voxels_bwd, voxels_fwd, voxels_tv
from clsplat.ops.weights import weights_bwd, weights_fwd


class Launches:
    """The functions of all stages with their first argument, the device, filled in."""

    def __init__(self, device: Device) -> None:
        self._add_fields(device)
        self.project_fwd = partial(project_fwd, device)
        self.join_rows = partial(join_rows, device)
        self.project_disparities = partial(project_disparities, device)
        self.project_bwd = partial(project_bwd, device)
        self.project_bwd_adam = partial(project_bwd_adam, device)
        self.disparity_fwd = partial(disparity_fwd, device)
        self.disparity_bwd = partial(disparity_bwd, device)
        self.dropout_fwd = partial(dropout_fwd, device)
        self.dropout_bwd = partial(dropout_bwd, device)
        self.bin_splats = partial(bin_splats, device)
        self.composite_fwd = partial(composite_fwd, device)
        self.composite_bwd = partial(composite_bwd, device)
        self.absgrad = partial(absgrad, device)
        self.count_pairs = partial(count_pairs, device)
        self.median_splats = partial(median_splats, device)
        self.removal = partial(removal, device)
        self.removal_sums = partial(removal_sums, device)
        self.removal_residuals = partial(removal_residuals, device)
        self.disparity_loss = partial(disparity_loss, device)
        self.disparity_grad = partial(disparity_grad, device)
        self.sweep_similarities = partial(sweep_similarities, device)
        self.sweep_best = partial(sweep_best, device)
        self.exposure_fwd = partial(exposure_fwd, device)
        self.exposure_bwd = partial(exposure_bwd, device)
        self.l1_ssim = partial(l1_ssim, device)
        self.observe = partial(observe, device)
        self.add_column = partial(add_column, device)
        self.adam_step = partial(adam_step, device)
        self.add_noise = partial(add_noise, device)
        self.take_rows = partial(take_rows, device)
        self.count_not_finite = partial(count_not_finite, device)
        self.pixel_sizes = partial(pixel_sizes, device)
        self.filter_fwd = partial(filter_fwd, device)
        self.filter_bwd = partial(filter_bwd, device)
        self.exclusive_scan = partial(exclusive_scan, device)
        self.argsort = partial(argsort, device)
        self.argsort_segments = partial(argsort_segments, device)
        self.adam_array = partial(adam_array, device)

    def _add_fields(self, device: Device) -> None:
        self.rays_fwd = partial(rays_fwd, device)
        self.rays_bwd = partial(rays_bwd, device)
        self.hashgrid_fwd = partial(hashgrid_fwd, device)
        self.hashgrid_bwd = partial(hashgrid_bwd, device)
        self.mlp_fwd = partial(mlp_fwd, device)
        self.mlp_bwd = partial(mlp_bwd, device)
        self.march = partial(march, device)
        self.spheres = partial(spheres, device)
        self.heads_join = partial(heads_join, device)
        self.heads_fwd = partial(heads_fwd, device)
        self.heads_bwd = partial(heads_bwd, device)
        self.heads_join_bwd = partial(heads_join_bwd, device)
        self.heads_sh_fwd = partial(heads_sh_fwd, device)
        self.heads_sh_bwd = partial(heads_sh_bwd, device)
        self.voxels_fwd = partial(voxels_fwd, device)
        self.voxels_bwd = partial(voxels_bwd, device)
        self.voxels_tv = partial(voxels_tv, device)
        self.heads_soft_fwd = partial(heads_soft_fwd, device)
        self.heads_soft_bwd = partial(heads_soft_bwd, device)
        self.encode_points = partial(encode_points, device)
        self.encode_join = partial(encode_join, device)
        self.encode_join_bwd = partial(encode_join_bwd, device)
        self.intervals_along = partial(intervals_along, device)
        self.intervals_resample = partial(intervals_resample, device)
        self.weights_fwd = partial(weights_fwd, device)
        self.weights_bwd = partial(weights_bwd, device)
        self.frustums_encode = partial(frustums_encode, device)
        self.histograms_interlevel = partial(histograms_interlevel, device)
        self.histograms_distortion = partial(histograms_distortion, device)
