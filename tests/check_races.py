"""The kernels under Oclgrind, which reports data races, divergent barriers and accesses out of bounds.

Run by `make check-races`; plain pytest leaves this file out, since a simulator is slow and few have it. Each case
runs in a process of its own under Oclgrind and checks its results against the twin: what was not run proves nothing.
"""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyopencl as cl
import pytest

import clsplat
from clsplat import ops, reference
from clsplat.camera import Camera
from clsplat.config import OptimConfig, RenderConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.stages import SplatGrads
from clsplat.training.optimizer import adam_settings

RACES = """
__kernel void race(__global int *x) {
    __local int last;
    last = get_local_id(0);
    barrier(CLK_LOCAL_MEM_FENCE);
    x[get_global_id(0)] = last;
}
__kernel void beyond(__global int *x) {
    x[get_global_id(0) + 2] = 0;
}
__kernel void divergent(__global int *x) {
    if (get_local_id(0) < 3)
        barrier(CLK_LOCAL_MEM_FENCE);
    x[get_global_id(0)] = 0;
}
"""


def device_like_a_gpu():
    """Oclgrind's device in double, configured like a GPU.

    Double, because Oclgrind ignores -cl-single-precision-constant: float's literals would not be of type real.
    """
    device = Device(real=np.float64)
    assert "oclgrind" in device.label.lower(), f"expected Oclgrind's device, found {device.label}"
    device.is_cpu = False  # Oclgrind says that it is of every type
    # Memory pools round sizes up, and what lies beyond an array but within its block would not be reported.
    allocator = cl.tools.ImmediateAllocator(device.queue)
    device.buffers.allocate = lambda what, nbytes: allocator(nbytes)
    return device


def control(device):
    """Kernels with the three faults, so that silence means something."""
    program = cl.Program(device.context, RACES).build()
    x = device.empty("x", 257, np.int32)  # a memory pool would round its 1028 bytes up
    for kernel in program.all_kernels():
        kernel(device.queue, (256,), (8,), x.data)
    device.queue.finish()


def sort(device):
    rng = np.random.default_rng(0)
    for n, dtype, method in [(1000, np.uint32, "bitonic"), (77, np.uint64, "bitonic"), (1500, np.uint32, "radix")]:
        keys = rng.integers(0, 200, n).astype(dtype)
        _, order = ops.argsort(device, device.upload("keys", keys, dtype), 8, method)
        np.testing.assert_array_equal(order.get(), np.argsort(keys, kind="stable"))


def segments(device):
    """Segments for the bitonic sort and, the last one, for the radix sort."""
    rng = np.random.default_rng(0)
    ends = np.cumsum([0, 1, 70, 300, 1100])
    ranges = np.stack([np.concatenate([[0], ends[:-1]]), ends], axis=1).astype(np.uint32)
    keys = rng.integers(0, 200, ends[-1]).astype(np.uint32)
    arrays = [device.upload("keys", a, a.dtype) for a in (keys, ranges)]
    order = ops.argsort_segments(device, arrays[0], 8, arrays[1])
    np.testing.assert_array_equal(order.get(), reference.argsort_segments(keys, 8, ranges))


def schemes(device):
    """Both orders of sorting, as on a CPU and as on a GPU, in an image that cuts tiles off."""
    camera = Camera(np.eye(4), 20, 20, 34, 18, 37, 21)
    splats = reference.project_fwd(scene(90, -1, 2).astype(np.float64), camera, 1)
    arrays = type(splats)(*(device.upload("splats", a) for a in splats))
    for scheme in ("global", "per_tile"):
        expected = reference.bin_splats(splats, 37, 21, 8, scheme=scheme)
        for device.is_cpu in (True, False):
            found = ops.bin_splats(device, arrays, 37, 21, 8, scheme=scheme)
            for a, b in zip(found[:4], expected[:4], strict=True):
                np.testing.assert_array_equal(a.get(), b)
            forward = ops.bin_splats(device, arrays, 37, 21, 8, scheme=scheme, gradients=False)
            np.testing.assert_array_equal(forward.gauss_ids.get(), expected.gauss_ids)


def scan(device):
    # 9000 values exceed the 8192 chunks: these have two or none.
    for n in (1, 63, 9000):
        values = np.random.default_rng(n).integers(0, 9, n).astype(np.uint32)
        sums, total = ops.exclusive_scan(device, device.upload("values", values, np.uint32))
        np.testing.assert_array_equal(sums.get(), np.concatenate([[0], np.cumsum(values)]))
        assert total == values.sum()


def loss(device):
    rng = np.random.default_rng(0)
    image, photo = rng.uniform(0, 1, (23, 35, 3)), rng.integers(0, 256, (23, 35, 3), dtype=np.uint8)
    mask = rng.integers(0, 2, (23, 35), dtype=np.uint8)
    arrays = [device.upload("image", a, a.dtype) for a in (image, photo, mask)]
    value, v_image = ops.l1_ssim(device, *arrays[:2], 0.2, arrays[2])
    expected_value, expected_v_image = reference.l1_ssim(image, photo, 0.2, mask)
    np.testing.assert_allclose(float(value), expected_value, rtol=1e-12)
    np.testing.assert_allclose(v_image.get(), expected_v_image, atol=1e-12 * np.abs(expected_v_image).max())


def exposure(device):
    """More pixels than a work-item has, and fewer than there are work-items."""
    rng = np.random.default_rng(0)
    affine = rng.normal(size=(3, 4))
    for is_cpu in (True, False):
        device.is_cpu = is_cpu
        for height, width in ((5, 7), (65, 64)):
            image, v = rng.uniform(0, 1, (height, width, 3)), rng.normal(size=(height, width, 3))
            photo = rng.choice([0, 128, 255], image.shape).astype(np.uint8)
            x, p, g = device.upload("image", image), device.upload("photo", photo, np.uint8), device.upload("v", v)
            adjusted = ops.exposure_fwd(device, x, affine, p)
            v_affine = ops.exposure_bwd(device, x, affine, p, g)
            np.testing.assert_allclose(adjusted.get(), reference.exposure_fwd(image, affine, photo), atol=1e-12)
            expected = reference.exposure_bwd(image, affine, photo, v)
            np.testing.assert_allclose(v_affine, expected, rtol=1e-9, atol=1e-9)
            np.testing.assert_allclose(g.get(), v, atol=1e-12)


def adam(device):
    """Runs of both widths that end inside an array, and rows of which the last bands are not trained."""
    for is_cpu in (True, False):
        device.is_cpu = is_cpu
        found = [scene(22, seed, 1).astype(np.float64) for seed in range(3)]
        found.append(Gaussians(**{name: array**2 for name, array in found[2].arrays().items()}))
        on_device = [Renderer(device).place(part) for part in found]
        step = adam_settings(3, 0.3, 1.0, OptimConfig(), 0)
        ops.adam_step(device, *on_device, step)
        reference.adam_step(*found, step)
        for a, b in zip(on_device, found, strict=True):
            for name, array in b.arrays().items():
                np.testing.assert_allclose(a.arrays()[name].get(), array, rtol=1e-12, atol=1e-14)


def fused(device):
    """The end of a training step: statistics, and gradients with Adam; each degree stored and trained."""
    camera = Camera(np.eye(4), 20, 20, 34, 18, 37, 21)
    for sh_degree in (0, 1):
        found = [scene(70, seed, 1).astype(np.float64) for seed in (-2, 1, 2)]
        found[2] = Gaussians(**{name: array**2 for name, array in found[2].arrays().items()})
        splats = reference.project_fwd(found[0], camera, sh_degree)
        rng = np.random.default_rng(0)
        v = SplatGrads(*(rng.normal(size=getattr(splats, name).shape) for name in SplatGrads._fields))
        statistics = [np.zeros(70), np.zeros(70, np.int32)]
        on_device = [Renderer(device).place(part) for part in found]
        arrays, v_arrays = (type(part)(*(device.upload("splats", a) for a in part)) for part in (splats, v))
        sums = [device.upload("sums", a, a.dtype) for a in statistics]
        ops.observe(device, arrays.extents, v_arrays.means2d, 37, 21, *sums)
        reference.observe(splats.extents, v.means2d, 37, 21, *statistics)
        step = adam_settings(3, 0.3, 1.0, OptimConfig(), sh_degree)
        parts, poses = (on_device[0], tuple(on_device[1:])), {"camera_grad": sh_degree > 0}
        v_camera = ops.project_bwd_adam(device, *parts, camera, arrays, v_arrays, step, **poses)
        v_expected = reference.project_bwd_adam(found[0], tuple(found[1:]), camera, splats, v, step, **poses)
        if sh_degree > 0:
            for found_part, expected_part in zip(v_camera, v_expected, strict=True):
                np.testing.assert_allclose(found_part, expected_part, rtol=1e-7)
        for a, b in zip(sums, statistics, strict=True):
            np.testing.assert_allclose(a.get(), b, rtol=1e-12)
        for part, expected in zip(on_device, found, strict=True):
            for name, array in expected.arrays().items():
                np.testing.assert_allclose(part.arrays()[name].get(), array, rtol=1e-9, atol=1e-12)


def removal(device):
    """Translucent splats and opaque ones, in an image that cuts tiles off."""
    residuals = np.random.default_rng(0).normal(size=(21, 37, 3))
    for splats, bins, arrays, lists in listed(device):
        found = ops.removal(device, arrays, lists, (0.1, 0.5, 0.9), residuals)
        expected = reference.removal(splats, bins, (0.1, 0.5, 0.9), residuals)
        for a, b in zip(found, expected, strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-10 * np.abs(b).max())


def listed(device):
    """Splats with their lists, of the twin and on the device: translucent ones and opaque ones."""
    camera = Camera(np.eye(4), 20, 20, 34, 18, 37, 21)
    for opacity_logit in (-2, 5):
        splats = reference.project_fwd(scene(90, opacity_logit, 2).astype(np.float64), camera, 1)
        arrays = type(splats)(*(device.upload("splats", a) for a in splats))
        bins = reference.bin_splats(splats, 37, 21, 16)
        yield splats, bins, arrays, ops.bin_splats(device, arrays, 37, 21, 16)


def absgrad(device):
    rng = np.random.default_rng(0)
    for splats, bins, arrays, lists in listed(device):
        image = reference.composite_fwd(splats, bins, (0.1, 0.5, 0.9))
        v_image = type(image)(*(rng.normal(size=a.shape) for a in image))
        pair = (type(image)(*(device.upload("image", a) for a in each)) for each in (image, v_image))
        expected = reference.absgrad(splats, bins, image, v_image)
        found = ops.absgrad(device, arrays, lists, *pair).get()
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-10 * expected.max())


def median(device):
    for splats, bins, arrays, lists in listed(device):
        found = ops.median_splats(device, arrays, lists).get()
        np.testing.assert_array_equal(found, reference.median_splats(splats, bins))


def sweep(device):
    """Planes that are resampled at once, and a rest of them; photos of other sizes."""
    rng = np.random.default_rng(0)
    photo, *sources = (rng.random(shape) for shape in ((19, 37), (22, 42), (19, 37), (2, 2)))
    maps = rng.normal([*np.eye(3).ravel(), 0, 0, 0], [*np.full(9, 0.01), 4, 4, 0.01], (3, 12))
    planes = np.linspace(0.25, 1, 7)
    uploaded = [device.upload("source", source) for source in sources]
    others = [device.upload(name, a) for name, a in (("maps", maps), ("planes", planes))]
    scores = ops.sweep_scores(device, device.upload("photo", photo), uploaded, *others)
    expected = reference.sweep_scores(photo, sources, maps, planes)
    np.testing.assert_allclose(scores.get(), expected, rtol=1e-9, atol=1e-9)
    for a, b in zip(ops.sweep_best(device, scores, others[1]), reference.sweep_best(expected, planes), strict=True):
        np.testing.assert_allclose(a.get(), b, rtol=1e-6, atol=1e-9)  # the parabola divides by small differences


def noise(device):
    found = scene(70, -3, 1).astype(np.float64)
    on_device = Renderer(device).place(found)
    ops.add_noise(device, on_device, 2.0, 5, 9)
    reference.add_noise(found, 2.0, 5, 9)
    np.testing.assert_allclose(on_device.means.get(), found.means, rtol=1e-12, atol=1e-14)


def scene(n, opacity_logit, scale):
    rng = np.random.default_rng(n)
    return Gaussians(
        rng.normal([0, 0, 4], 0.5, (n, 3)),
        np.log(scale * rng.uniform(0.03, 0.2, (n, 3))),
        rng.normal(size=(n, 4)),
        rng.normal(opacity_logit, 1, n),
        rng.normal(0, 0.3, (n, 4, 3)),
    ).astype(np.float32)


def pipeline(device, compositor, tile_size):
    """Every stage, forward and backward: translucent splats, and opaque ones that stop early; lists of none to over
    100, the longest in tiles that the image cuts off."""
    camera = Camera(np.eye(4), 20, 20, 34, 18, 37, 21)
    config = RenderConfig(tile_size=tile_size, compositor=compositor)
    rng = np.random.default_rng(0)
    v = rng.normal(size=(21, 37, 3))
    for opacity_logit, scale in ((-2, 1), (5, 3)):
        gaussians = scene(160, opacity_logit, scale)
        found, expected = (
            render(gaussians, camera, config, where, background=(0.1, 0.5, 0.9)) for where in (device, "reference")
        )
        np.testing.assert_allclose(found.rgb, expected.rgb, atol=1e-12)
        v_found, v_expected = (r.backward(v, viewmat_grad=True) for r in (found, expected))
        for name, array in v_expected.gaussians.arrays().items():
            atol = 1e-10 * np.abs(array).max()
            np.testing.assert_allclose(v_found.gaussians.arrays()[name], array, atol=atol, rtol=1e-9)
        np.testing.assert_allclose(v_found.viewmat, v_expected.viewmat, rtol=1e-7)


def networks(device):
    """Rows beyond the last tile, and two layers, forward and backward."""
    widths, rng = (32, 48, 16), np.random.default_rng(0)
    x, v = (device.upload("rows", rng.normal(size=(70, width))) for width in (32, 16))
    weights = device.upload("weights", rng.normal(size=32 * 48 + 48 * 16))
    _, hidden = ops.mlp_fwd(device, x, weights, widths)
    ops.mlp_bwd(device, x, weights, widths, hidden, v, widths[0])[1].get()


CASES = {
    "control": control,
    "sort": sort,
    "segments": segments,
    "schemes": schemes,
    "scan": scan,
    "loss": loss,
    "exposure": exposure,
    "adam": adam,
    "noise": noise,
    "fused": fused,
    "networks": networks,
    "removal": removal,
    "absgrad": absgrad,
    "median": median,
    "sweep": sweep,
    "gpu-8": lambda device: pipeline(device, "gpu", 8),
    "gpu-16": lambda device: pipeline(device, "gpu", 16),
    "cpu-16": lambda device: pipeline(device, "cpu", 16),
}


def run_under_oclgrind(case, log):
    """What Oclgrind reports about a case."""
    oclgrind = shutil.which("oclgrind")
    if oclgrind is None:
        pytest.skip("oclgrind is missing: install it (Debian: apt install oclgrind) to check the kernels for races")
    package = str(Path(clsplat.__file__).resolve().parents[1])
    env = os.environ | {"PYTHONPATH": os.pathsep.join([package, os.environ.get("PYTHONPATH", "")])}
    # Optimised or inlined functions leave annotations behind that Oclgrind 21.10 takes for calls.
    # It does not know Clang's count of zeros either (cl/composite_blocks.h).
    env["PYOPENCL_BUILD_OPTIONS"] = "-cl-opt-disable -DWITHOUT_CTZ -DINLINED=static"
    # It adds up the local memory of all kernels of a program, and reals have twice the bytes that they have on a GPU.
    options = ["--data-races", "--local-mem-size", "65536", "--log", str(log)]
    command = [oclgrind, *options, sys.executable, __file__, case]
    result = subprocess.run(command, env=env, capture_output=True, text=True, timeout=600)
    assert result.returncode == 0, result.stdout + result.stderr
    return log.read_text() if log.exists() else ""


def test_oclgrind_finds_planted_faults(tmp_path):
    report = run_under_oclgrind("control", tmp_path / "log")
    for fault in ("data race at local memory", "Invalid write", "Work-group divergence"):
        assert fault in report


@pytest.mark.parametrize("case", [case for case in CASES if case != "control"])
def test_no_faults(case, tmp_path):
    report = run_under_oclgrind(case, tmp_path / "log")
    assert not report.strip(), report[:4000]


if __name__ == "__main__":
    CASES[sys.argv[1]](device_like_a_gpu())
