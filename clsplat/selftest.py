"""A test of a device: every stage on a small scene, against its twin. `clsplat devices` runs it in a separate process
for each device, because a faulty driver can end the process."""

from collections.abc import Callable, Iterator
from multiprocessing import get_context
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat import field_selftest, reference
from clsplat.camera import Camera
from clsplat.config import OptimConfig
from clsplat.gaussians import SHAPES, Gaussians
from clsplat.stages import AdamStep, Bins, Dropout, Image, RaySplats, SplatGrads, Splats
from clsplat.testing import synthetic_scene

if TYPE_CHECKING:
    from clsplat.device import Device

Array = NDArray[Any]

TOLERANCES = {"float32": 1e-4, "float64": 1e-9}
"""Largest error of a value, relative to the largest value of its array: a hundred times the rounding of sums in each
precision. A wrong kernel is wrong by far more."""

TIME_LIMIT = 600.0
"""Seconds after which a device has failed. The slowest known driver (rusticl on llvmpipe) builds for two minutes."""

BACKGROUND = (0.2, 0.5, 0.8)
WIDTH, HEIGHT, TILE = 37, 29, 16
COUNT = 40
"""Number of Gaussians: many enough that they overlap, and few enough for the twins to take no time."""

Found = Iterator[tuple[Any, Any]]
"""Pairs of an array of the device and that of the twin."""


class Bench:
    """The inputs of the stages, computed by the twins, on the host and on the device.

    Thresholds are far away from all values of the scene: no rounding decides whether a splat is drawn.
    """

    def __init__(self, device: "Device"):
        from clsplat.ops import Launches

        self.device, self.stages = device, Launches(device)
        self.rng = np.random.default_rng(0)
        gaussians, self.camera = synthetic_scene(COUNT, 1, width=WIDTH, height=HEIGHT, margin=1e-3)
        self.gaussians = Gaussians(**{k: self.rounded(a) for k, a in gaussians.arrays().items()})
        self.splats = Splats(*map(self.rounded, reference.project_fwd(self.gaussians, self.camera, 3)))
        self.bins = reference.bin_splats(self.splats, WIDTH, HEIGHT, TILE)
        self.image = Image(*map(self.rounded, reference.composite_fwd(self.splats, self.bins, BACKGROUND)))
        self.v_image = Image(*(self.rounded(self.rng.normal(size=a.shape)) for a in self.image))
        self.v_splats = SplatGrads(
            *(self.rounded(self.rng.normal(size=getattr(self.splats, k).shape)) for k in SplatGrads._fields)
        )

    def rounded(self, array: Any) -> Array:
        """The values of an array as the device has them, in float64."""
        return np.asarray(array).astype(self.device.real).astype(np.float64)

    def up(self, part: Any) -> Any:
        """A container or an array on the device; indices stay integers."""
        if isinstance(part, Gaussians):
            return Gaussians(**{k: self.up(a) for k, a in part.arrays().items()})
        if isinstance(part, tuple):
            return type(part)(*(self.up(a) for a in part))
        if not isinstance(part, np.ndarray):
            return part
        kinds = {"i": np.int32, "u": np.uint32, "b": np.uint8}
        dtype = np.uint8 if part.dtype == np.uint8 else kinds.get(part.dtype.kind)
        return self.device.upload("self-test", part, dtype)

    def lists(self) -> Bins:
        """The lists of the tiles on the device; their indices are unsigned."""
        gauss_ids, ranges, first, slots = (self.device.upload("self-test", a, np.uint32) for a in self.bins[:4])
        return Bins(gauss_ids, ranges, first, slots, TILE, WIDTH, HEIGHT)

    def random(self, *shape: int) -> Array:
        """Normal random values."""
        return self.rounded(self.rng.normal(size=shape))

    def adam(self, sh_degree: int) -> tuple[list[Gaussians], AdamStep]:
        """Parameters, gradients and moments of a step of Adam, and the step."""
        parts = [self.gaussians]
        for sign in (1, 1, 2):
            arrays = self.gaussians.arrays().items()
            parts.append(Gaussians(**{k: np.abs(self.random(*a.shape)) ** sign for k, a in arrays}))
        config = OptimConfig()
        rates = {k: 1e-2 for k in (*SHAPES, "sh0", "sh_rest")}
        step = AdamStep(7, rates, config.beta1, config.beta2, config.eps, sh_degree, (0.1, 0.1, 0.0))
        return [copied(p) for p in parts], step


def copied(gaussians: Gaussians) -> Gaussians:
    """Gaussians that share nothing."""
    return Gaussians(**{k: a.copy() for k, a in gaussians.arrays().items()})


def pairs(found: Any, expected: Any) -> Found:
    """The arrays of two containers of one type."""
    both = [c.arrays().values() if isinstance(c, Gaussians) else c for c in (found, expected)]
    yield from zip(*both, strict=True)


def test_absgrad(b: Bench) -> Found:
    found = b.stages.absgrad(b.up(b.splats), b.lists(), b.up(b.image), b.up(b.v_image))
    yield found, reference.absgrad(b.splats, b.bins, b.image, b.v_image)


def test_adam(b: Bench) -> Found:
    (parameters, gradients, first, second), step = b.adam(2)
    found = b.up(parameters), b.up(gradients), b.up(first), b.up(second)
    b.stages.adam_step(found[0], found[1], found[2], found[3], step)
    reference.adam_step(parameters, gradients, first, second, step)
    for part, expected in zip(found, (parameters, gradients, first, second), strict=True):
        yield from pairs(part, expected)


def test_bin(b: Bench) -> Found:
    for scheme in ("global", "per_tile"):
        found = b.stages.bin_splats(b.up(b.splats), WIDTH, HEIGHT, TILE, scheme=scheme)
        yield from pairs(found[:4], reference.bin_splats(b.splats, WIDTH, HEIGHT, TILE, scheme=scheme)[:4])


def test_composite(b: Bench) -> Found:
    splats, lists = b.up(b.splats), b.lists()
    yield from pairs(b.stages.composite_fwd(splats, lists, BACKGROUND), b.image)
    found = b.stages.composite_bwd(splats, lists, b.up(b.image), b.up(b.v_image))
    yield from pairs(found, reference.composite_bwd(b.splats, b.bins, b.image, b.v_image))


def test_count(b: Bench) -> Found:
    yield from pairs(b.stages.count_pairs(b.up(b.splats), b.lists()), reference.count_pairs(b.splats, b.bins))


def test_disparity(b: Bench) -> Found:
    expected = Splats(*map(b.rounded, reference.project_fwd(b.gaussians, b.camera, 3, channels=4)))
    found = b.up(expected)
    b.stages.disparity_fwd(found)
    reference.disparity_fwd(expected)
    yield from pairs(found, expected)
    v_expected = SplatGrads(*(b.random(*getattr(expected, k).shape) for k in SplatGrads._fields))
    v_found = b.up(v_expected)
    b.stages.disparity_bwd(found, v_found)
    reference.disparity_bwd(expected, v_expected)
    yield from pairs(v_found, v_expected)
    image, target = b.random(HEIGHT, WIDTH, 4), b.random(HEIGHT, WIDTH)
    loss, rgb = b.stages.disparity_loss(b.up(image), b.up(target), 0.5)
    loss_expected, rgb_expected = reference.disparity_loss(image, target, 0.5)
    yield from pairs((np.array(loss), rgb), (np.array(loss_expected), rgb_expected))
    joined = b.stages.disparity_grad(b.up(image), b.up(target), 0.5, rgb)
    yield joined, reference.disparity_grad(image, target, 0.5, rgb_expected)


def test_dropout(b: Bench) -> Found:
    dropout, found = Dropout(0.4, 3, 5), b.up(b.splats)
    expected = Splats(*(a.copy() for a in b.splats))
    b.stages.dropout_fwd(found, dropout)
    reference.dropout_fwd(expected, dropout)
    yield from pairs(found, expected)


def test_exposure(b: Bench) -> Found:
    first, photo = b.random(3, 4), b.rng.choice([0, 128, 255], b.image.rgb.shape).astype(np.uint8)
    image, v = b.image.rgb, b.v_image.rgb
    for affine in (first, np.concatenate([first, first[:, :2]], axis=1)):
        yield b.stages.exposure_fwd(b.up(image), affine, b.up(photo)), reference.exposure_fwd(image, affine, photo)
        found, expected = b.up(v), v.copy()
        v_affine = reference.exposure_bwd(image, affine, photo, expected)
        yield b.stages.exposure_bwd(b.up(image), affine, b.up(photo), found), v_affine
        yield found, expected


def test_filter(b: Bench) -> Found:
    sizes = b.stages.pixel_sizes(b.up(b.gaussians), [b.camera])
    expected = reference.pixel_sizes(b.gaussians, [b.camera])
    yield sizes, expected
    pixels = 20 * b.rounded(expected)  # larger than a pixel, so that the filter acts
    yield from pairs(b.stages.filter_fwd(b.up(b.gaussians), b.up(pixels)), reference.filter_fwd(b.gaussians, pixels))


def test_finite(b: Bench) -> Found:
    values = b.random(100)
    values[[3, 50]] = np.nan, np.inf
    yield np.array(b.stages.count_not_finite(b.up(values))), np.array(2)


def test_take(b: Bench) -> Found:
    values, rows = b.random(40, 3), np.array([39, -1, 0, 0, 7])
    yield b.stages.take_rows(b.up(values), b.up(rows)), reference.take_rows(values, rows)


def test_loss(b: Bench) -> Found:
    photo = b.rng.integers(0, 256, b.image.rgb.shape, dtype=np.uint8)
    photo ^= np.abs(photo / 255 - b.image.rgb) < 1e-3  # where both are equal, rounding decides the sign of L1
    loss, v_image = b.stages.l1_ssim(b.up(b.image.rgb), b.up(photo), 0.2)
    expected, v_expected = reference.l1_ssim(b.image.rgb, photo, 0.2)
    yield np.array(float(loss)), np.array(expected)
    yield v_image, v_expected


def test_median(b: Bench) -> Found:
    along = reference.project_fwd(b.gaussians, b.camera, 3, rays=True)
    for splats in (b.splats, RaySplats(*map(b.rounded, along))):
        found = b.stages.median_splats(b.up(splats), b.stages.bin_splats(b.up(splats), WIDTH, HEIGHT, TILE)).get()
        same = found == reference.median_splats(splats, reference.bin_splats(splats, WIDTH, HEIGHT, TILE))
        yield np.array(same.mean() > 0.99, int), np.array(1)  # rounding decides where the transmittance is nearly 1/2


def test_noise(b: Bench) -> Found:
    found, expected = b.up(b.gaussians), copied(b.gaussians)
    b.stages.add_noise(found, 2.0, 5, 9)
    reference.add_noise(expected, 2.0, 5, 9)
    yield found.means, expected.means


def test_observe(b: Bench) -> Found:
    grad_sum, seen = np.zeros(COUNT), np.zeros(COUNT, np.int32)
    found = b.up(grad_sum), b.up(seen)
    b.stages.observe(b.up(b.splats.extents), b.up(b.v_splats.means2d), WIDTH, HEIGHT, found[0], found[1])
    reference.observe(b.splats.extents, b.v_splats.means2d, WIDTH, HEIGHT, grad_sum, seen)
    yield from pairs(found, (grad_sum, seen))
    values, sums = b.random(COUNT, 3), np.zeros((COUNT, 2))
    added = b.up(sums)
    b.stages.add_column(b.up(values), 1, added, 0.3)
    reference.add_column(values, 1, sums, 0.3)
    yield added, sums


def test_project(b: Bench) -> Found:
    splats = b.up(b.splats)
    arguments: tuple[Gaussians, Camera] = b.up(b.gaussians), b.camera
    yield from pairs(b.stages.project_fwd(*arguments, 3), reference.project_fwd(b.gaussians, b.camera, 3))
    yield from pairs([b.stages.join_rows(splats.conics, splats.conics)], [np.concatenate([b.splats.conics] * 2)])
    found, v_camera = b.stages.project_bwd(*arguments, 3, splats, b.up(b.v_splats), camera_grad=True)
    expected, v_expected = reference.project_bwd(b.gaussians, b.camera, 3, b.splats, b.v_splats, camera_grad=True)
    yield from pairs(found, expected)
    assert v_camera and v_expected
    yield from pairs(v_camera, v_expected)
    (parameters, _, *moments), step = b.adam(3)
    on_device = b.up(parameters), (b.up(moments[0]), b.up(moments[1]))
    b.stages.project_bwd_adam(*on_device, b.camera, splats, b.up(b.v_splats), step)
    both = moments[0], moments[1]
    reference.project_bwd_adam(parameters, both, b.camera, b.splats, b.v_splats, step)
    yield from pairs(on_device[0], parameters)


def test_removal(b: Bench) -> Found:
    residuals = b.random(*b.image.rgb.shape)
    found = b.stages.removal(b.up(b.splats), b.lists(), BACKGROUND, residuals)
    yield from pairs(found, reference.removal(b.splats, b.bins, BACKGROUND, residuals))
    photo = b.rng.integers(0, 256, b.image.rgb.shape, dtype=np.uint8)
    residuals_found = b.stages.removal_residuals(b.up(b.image.rgb), b.up(photo))
    yield residuals_found, reference.removal_residuals(b.rounded(b.image.rgb), photo)


def test_scan(b: Bench) -> Found:
    values = b.rng.integers(0, 9, 9000).astype(np.uint32)
    sums, total = b.stages.exclusive_scan(b.up(values))
    yield sums, np.concatenate([[0], np.cumsum(values)])
    yield np.array(total), np.array(values.sum())


def test_sort(b: Bench) -> Found:
    for count in (500, 5000):
        keys = b.rng.integers(0, 2**16, count).astype(np.uint32)
        _, order = b.stages.argsort(b.up(keys), 16)
        yield order, np.argsort(keys, kind="stable")


def test_sweep(b: Bench) -> Found:
    grey, planes = b.random(HEIGHT, WIDTH), np.array([1.0, 2, 3])
    maps = np.array([[1, 0, 0, 0, 1, 0, 0, 0, 1, x, 0.4, 0] for x in (0.3, -0.3)])
    found = b.stages.sweep_scores(b.up(grey), [b.up(grey)] * 2, b.up(maps), b.up(planes))
    expected = reference.sweep_scores(grey, [grey] * 2, maps, planes)
    yield found, expected
    yield from zip(b.stages.sweep_best(found, b.up(planes)), reference.sweep_best(expected, planes), strict=True)


TESTS: dict[str, Callable[[Bench], Found]] = {
    name.removeprefix("test_"): function
    for name, function in (globals() | vars(field_selftest)).items()
    if name.startswith("test_")
}
"""The test of each stage."""


def error_of(found: Any, expected: Any) -> float:
    """Largest difference of two arrays, relative to the largest expected value; infinite where one is not finite."""
    found = np.asarray(found if isinstance(found, (np.ndarray, np.number)) else found.get(), np.float64)
    if found.shape != np.shape(expected) or not np.isfinite(found).all():
        return np.inf
    scale = np.abs(expected).max(initial=0)
    return float(np.abs(found - expected).max(initial=0) / (scale or 1))


def reason(failure: Exception) -> str:
    """One line of an error: what the compiler says is in a later line than that it failed."""
    lines = str(failure).strip().splitlines() or [type(failure).__name__]
    return next((line.strip() for line in lines if "error:" in line), lines[0])


def faults(device: "Device") -> dict[str, str]:
    """Stages that a device computes wrong or not at all, each with what was seen; empty for a device that works."""
    tolerance, result = TOLERANCES[device.real.name], {}
    bench = Bench(device)
    for stage, test in TESTS.items():
        try:
            error = max(error_of(found, expected) for found, expected in test(bench))
            if not error <= tolerance:
                result[stage] = f"expected errors below {tolerance:g}, found {error:.2g}"
        except Exception as failure:  # of any kind: the driver raises it
            result[stage] = reason(failure)
    return result


def _report(index: int, answers: Any) -> None:
    from clsplat.device import Device, list_devices

    try:
        answers.send(faults(Device(list_devices()[index])))
    except Exception as failure:  # of any kind: the driver raises it
        answers.send({"device": reason(failure)})


def faults_of(index: int) -> dict[str, str]:
    """`faults` of the device with this index in `clsplat.device.list_devices`, tested in a separate process.

    A driver that ends the process, or takes longer than `TIME_LIMIT`, is a fault of "device".
    """
    context = get_context("spawn")
    answers, answer = context.Pipe(duplex=False)
    process = context.Process(target=_report, args=(index, answer), daemon=True)
    process.start()
    answer.close()
    try:
        if answers.poll(TIME_LIMIT):
            result: dict[str, str] = answers.recv()
            return result
        return {"device": f"no answer within {TIME_LIMIT:.0f} s"}
    except EOFError:
        process.join()
        return {"device": f"the driver ended the process (exit status {process.exitcode})"}
    finally:
        process.kill()
        process.join()
