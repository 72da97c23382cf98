"""Launches of the stages: for each function of `clsplat.stages.Stages`, one that launches its kernels on a device.

Belongs here: shapes, dtypes, buffers and the order of launches, one module per stage. Does not belong here: the
mathematics, which is in cl/ and, as NumPy, in `clsplat.reference`.
"""

from collections.abc import Callable
from functools import wraps
from typing import Concatenate, ParamSpec, TypeVar

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
from clsplat.ops.sweep import sweep_best, sweep_scores
from clsplat.ops.take import take_rows
from clsplat.ops.voxels import voxels_bwd, voxels_fwd, voxels_tv
from clsplat.ops.weights import weights_bwd, weights_fwd

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def _held(
    function: Callable[Concatenate[Device, Parameters], Result], device: Device
) -> Callable[Parameters, Result]:
    """A function with the device filled in, which holds the device's lock."""

    @wraps(function)
    def launch(*args: Parameters.args, **options: Parameters.kwargs) -> Result:
        with device.lock:
            return function(device, *args, **options)

    return launch


class Launches:
    """The functions of all stages with their first argument, the device, filled in.

    Threads take turns: between the launches of a function there are none of another.
    """

    def __init__(self, device: Device) -> None:
        self._add_fields(device)
        self.project_fwd = _held(project_fwd, device)
        self.join_rows = _held(join_rows, device)
        self.project_disparities = _held(project_disparities, device)
        self.project_bwd = _held(project_bwd, device)
        self.project_bwd_adam = _held(project_bwd_adam, device)
        self.disparity_fwd = _held(disparity_fwd, device)
        self.disparity_bwd = _held(disparity_bwd, device)
        self.dropout_fwd = _held(dropout_fwd, device)
        self.dropout_bwd = _held(dropout_bwd, device)
        self.bin_splats = _held(bin_splats, device)
        self.composite_fwd = _held(composite_fwd, device)
        self.composite_bwd = _held(composite_bwd, device)
        self.absgrad = _held(absgrad, device)
        self.count_pairs = _held(count_pairs, device)
        self.median_splats = _held(median_splats, device)
        self.removal = _held(removal, device)
        self.removal_sums = _held(removal_sums, device)
        self.removal_residuals = _held(removal_residuals, device)
        self.disparity_loss = _held(disparity_loss, device)
        self.disparity_grad = _held(disparity_grad, device)
        self.sweep_scores = _held(sweep_scores, device)
        self.sweep_best = _held(sweep_best, device)
        self.exposure_fwd = _held(exposure_fwd, device)
        self.exposure_bwd = _held(exposure_bwd, device)
        self.l1_ssim = _held(l1_ssim, device)
        self.observe = _held(observe, device)
        self.add_column = _held(add_column, device)
        self.adam_step = _held(adam_step, device)
        self.add_noise = _held(add_noise, device)
        self.take_rows = _held(take_rows, device)
        self.count_not_finite = _held(count_not_finite, device)
        self.pixel_sizes = _held(pixel_sizes, device)
        self.filter_fwd = _held(filter_fwd, device)
        self.filter_bwd = _held(filter_bwd, device)
        self.exclusive_scan = _held(exclusive_scan, device)
        self.argsort = _held(argsort, device)
        self.argsort_segments = _held(argsort_segments, device)
        self.adam_array = _held(adam_array, device)

    def _add_fields(self, device: Device) -> None:
        self.rays_fwd = _held(rays_fwd, device)
        self.rays_bwd = _held(rays_bwd, device)
        self.hashgrid_fwd = _held(hashgrid_fwd, device)
        self.hashgrid_bwd = _held(hashgrid_bwd, device)
        self.mlp_fwd = _held(mlp_fwd, device)
        self.mlp_bwd = _held(mlp_bwd, device)
        self.march = _held(march, device)
        self.spheres = _held(spheres, device)
        self.heads_join = _held(heads_join, device)
        self.heads_fwd = _held(heads_fwd, device)
        self.heads_bwd = _held(heads_bwd, device)
        self.heads_join_bwd = _held(heads_join_bwd, device)
        self.heads_sh_fwd = _held(heads_sh_fwd, device)
        self.heads_sh_bwd = _held(heads_sh_bwd, device)
        self.voxels_fwd = _held(voxels_fwd, device)
        self.voxels_bwd = _held(voxels_bwd, device)
        self.voxels_tv = _held(voxels_tv, device)
        self.heads_soft_fwd = _held(heads_soft_fwd, device)
        self.heads_soft_bwd = _held(heads_soft_bwd, device)
        self.encode_points = _held(encode_points, device)
        self.encode_join = _held(encode_join, device)
        self.encode_join_bwd = _held(encode_join_bwd, device)
        self.intervals_along = _held(intervals_along, device)
        self.intervals_resample = _held(intervals_resample, device)
        self.weights_fwd = _held(weights_fwd, device)
        self.weights_bwd = _held(weights_bwd, device)
        self.frustums_encode = _held(frustums_encode, device)
        self.histograms_interlevel = _held(histograms_interlevel, device)
        self.histograms_distortion = _held(histograms_distortion, device)
