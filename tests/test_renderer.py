"""The renderer: its default device, the reference by name, Gaussians of host and device."""

from concurrent.futures import ThreadPoolExecutor
from time import sleep

import numpy as np
import pyopencl as cl
import pytest

import clsplat.device
from clsplat import Renderer, render
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import SH_C0
from clsplat.device import Device
from clsplat.errors import DeviceError, InputError
from clsplat.gaussians import Gaussians
from clsplat.render import renderings
from clsplat.renderer import default_device, download, fetch, opened_device
from clsplat.stages import Image
from clsplat.testing import synthetic_scene


def test_the_default_is_one_device():
    assert Renderer().device is Renderer().device is default_device()
    gaussians, camera = synthetic_scene(20)
    assert render(gaussians, camera).rgb.dtype == np.float32, "not the float64 reference"


def test_the_reference_is_asked_for_by_name():
    gaussians, camera = synthetic_scene(20)
    assert Renderer("reference").device is None
    assert render(gaussians, camera, device="reference").rgb.dtype == np.float64
    with pytest.raises(InputError, match=r'device: expected a Device, None or "reference", found \'cpu\''):
        render(gaussians, camera, device="cpu")


def test_without_opencl_the_error_names_the_reference(monkeypatch):
    monkeypatch.setattr(clsplat.device, "list_devices", list)
    opened_device.cache_clear()
    try:
        with pytest.raises(DeviceError, match=r'no OpenCL device found: .*device="reference"'):
            Renderer()
        gaussians, camera = synthetic_scene(5)
        assert np.isfinite(render(gaussians, camera, device="reference").rgb).all()
    finally:
        opened_device.cache_clear()


def test_threads_share_a_device(monkeypatch):
    """With another camera, size and background each, and with a pause before each kernel is queued."""

    class Slow:
        def __init__(self, program, name, kernel=cl.Kernel):
            self._kernel = kernel(program, name)
            self.set_scalar_arg_dtypes = self._kernel.set_scalar_arg_dtypes

        def __call__(self, queue, global_size, group, *arguments):
            self._kernel.set_args(*arguments)
            sleep(1e-4)
            cl.enqueue_nd_range_kernel(queue, self._kernel, global_size, group)

    gaussians, camera = synthetic_scene(200)
    device = Device()
    cameras = [camera, camera.translated(np.array([1.0, 0.0, 0.0])).resized(24, 28)]

    def work(k):
        rendering = render(gaussians, cameras[k], device=device, background=(k, k, k))
        gradients = rendering.backward(np.ones_like(rendering.rgb)).gaussians
        return rendering.rgb, gradients.means

    expected = [work(k) for k in range(2)]
    device._kernels.clear()
    monkeypatch.setattr(cl, "Kernel", Slow)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(work, 10 * [0, 1]))
    for k, arrays in enumerate(found):
        for one, other in zip(arrays, expected[k % 2], strict=True):
            np.testing.assert_array_equal(one, other)


def test_threads_open_one_default_device(monkeypatch):
    class Slow:
        def __init__(self):
            sleep(0.01)

    monkeypatch.setattr(clsplat.device, "Device", Slow)
    opened_device.cache_clear()
    try:
        with ThreadPoolExecutor(4) as pool:
            assert len(set(pool.map(lambda _: default_device(), range(4)))) == 1
    finally:
        opened_device.cache_clear()


@pytest.mark.parametrize("where", ["device", "reference"])
def test_gaussians_of_host_and_device(device, where, monkeypatch):
    gaussians, camera = synthetic_scene(30)
    gaussians = gaussians.astype(np.float32)
    placed = Renderer(device).place(gaussians)
    renderer = Renderer(device if where == "device" else "reference")
    expected, found = (next(renderings(renderer, g, [camera])).rgb for g in (gaussians, placed))
    np.testing.assert_array_equal(found, expected)


def test_what_is_on_the_device_is_not_uploaded_again(device, monkeypatch):
    gaussians, camera = synthetic_scene(30)
    renderer = Renderer(device)
    placed = renderer.place(gaussians.astype(np.float32))
    assert renderer.place(placed) is placed
    uploads = []
    upload = Device.upload
    monkeypatch.setattr(Device, "upload", lambda self, what, *a: uploads.append(what) or upload(self, what, *a))
    next(renderings(renderer, placed, [camera]))
    assert not set(uploads) & set(Gaussians.__dataclass_fields__)
    for name, array in fetch(placed).arrays().items():
        np.testing.assert_array_equal(array, gaussians.astype(np.float32).arrays()[name])


@pytest.mark.parametrize("sort", ["global", "pixel"])
@pytest.mark.parametrize("where", ["device", "reference"])
def test_a_backdrop_is_drawn_and_has_no_gradients(device, where, sort):
    """As if its Gaussians were among the others, to the bit."""
    gaussians, camera = synthetic_scene(60)
    gaussians = gaussians.astype(np.float32)
    own, others = gaussians.take(np.arange(25)), gaussians.take(np.arange(25, 60))
    config = RenderConfig(sort=sort)
    place = device if where == "device" else "reference"
    v_image = np.random.default_rng(0).normal(size=(camera.height, camera.width, 4))
    found = []
    for renderer, shown in (
        (Renderer(place, config), gaussians),
        (Renderer(place, config, backdrop=others), own),
        (Renderer(place, config), own),
    ):
        run = renderer.forward(shown, camera, depth=True)
        v = Image(renderer.upload("v", v_image), renderer.upload("v", np.zeros(v_image.shape[:2])))
        gradients = renderer.backward(run, v)
        found.append((download(run.image.rgb), *fetch(gradients.gaussians).arrays().values(), gradients.means2d))
    whole, split, alone = ([download(array) for array in arrays] for arrays in found)
    np.testing.assert_array_equal(split[0], whole[0])
    for a, b in zip(split[1:], whole[1:], strict=True):
        np.testing.assert_array_equal(a, b[:25])
    assert not np.array_equal(alone[0], whole[0])


@pytest.mark.parametrize(
    ("width", "is_cpu", "settings", "size"),
    [
        (16, True, {}, 32),
        (8, True, {}, 16),
        (16, False, {}, 8),
        (16, True, {"compositor": "gpu"}, 8),
        (16, False, {"compositor": "cpu"}, 32),
        (16, False, {"sort": "pixel"}, 8),
        (16, True, {"sort": "pixel"}, 16),
        (8, True, {"tile_size": 32}, 32),
    ],
)
def test_the_size_of_tiles_follows_the_variant_and_its_vectors(width, is_cpu, settings, size):
    device = Device()
    device.vector_width, device.is_cpu = width, is_cpu  # shadow the cached properties
    camera = Camera.look_at((0, 0, -3), (0, 0, 0), (0, 1, 0), 50, 40, 30)
    assert Renderer(device, RenderConfig(**settings)).tile_size(camera) == size


@pytest.mark.parametrize("where", ["device", "reference"])
@pytest.mark.parametrize("sort", ["auto", "pixel"])
def test_a_pass_in_other_colours_is_that_of_gaussians_with_them(device, where, sort):
    gaussians, camera = synthetic_scene(30)
    renderer = Renderer(device if where == "device" else "reference", RenderConfig(sort=sort), (0.2, 0.5, 0.1))
    white = np.random.default_rng(0).random(30) < 0.5
    sh = np.repeat(np.where(white, 0.5, -0.5) / SH_C0, 3).reshape(30, 1, 3)
    marked = Gaussians(**gaussians.arrays() | {"sh": sh})
    black = Renderer(renderer.device or "reference", renderer.config)
    expected = black.forward(marked.astype(np.float32), camera).image

    marks = renderer.upload("marks", np.repeat(white[:, None], 3, axis=1))
    found = renderer.recolored(renderer.forward(gaussians.astype(np.float32), camera), marks)
    # Colours of exactly 0 and 1 instead of those of harmonics in single precision.
    np.testing.assert_allclose(download(found.rgb), download(expected.rgb), atol=1e-6)
    np.testing.assert_array_equal(download(found.alpha), download(expected.alpha))
    assert 0.1 < download(found.rgb).max() <= 1
