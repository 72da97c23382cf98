"""No kernel writes beyond the end of an array: numbers of rows that leave work-items over, and what follows them."""

from dataclasses import replace
from functools import partial

import numpy as np
import pyopencl as cl
import pytest
from ball_photos import ball
from small_fields import SmallIngp, SmallMipNerf360, SmallNerf, SmallPlenoxels

from clsplat.bench.stability.small import CONFIG, small_scene
from clsplat.config import BACKGROUNDS, DataConfig, TrainConfig
from clsplat.device import Device
from clsplat.fields.field_training import train_field
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene
from clsplat.training.densify import STRATEGIES
from clsplat.training.loop import train

GUARD = 256
"""Bytes behind each array that nothing may change."""

PATTERNS = 251
"""Number of values of guard bytes, in turn: a kernel may copy those of one array behind another one."""


class GuardedDevice(Device):
    """A device whose arrays are each followed by guard bytes."""

    def __init__(self, *, is_cpu: bool) -> None:
        super().__init__()
        self.is_cpu = is_cpu  # shadows the cached property
        self.guarded = []
        self.buffers.allocate = partial(self._allocate, self.buffers.allocate)

    def _allocate(self, allocate, what, nbytes):
        block = allocate(what, nbytes + GUARD)
        value = np.uint8(1 + len(self.guarded) % PATTERNS)
        cl.enqueue_fill_buffer(self.queue, block, value, nbytes, GUARD)
        self.guarded.append((what, nbytes, block, value))  # also keeps the memory from being used again
        return block

    def overwritten(self):
        """Names of the arrays behind which something was written."""
        found = set()
        for what, nbytes, block, value in self.guarded:
            guard = np.empty(GUARD, np.uint8)
            cl.enqueue_copy(self.queue, guard, block, src_offset=nbytes)
            if (guard != value).any():
                found.add(what)
        return found


@pytest.fixture(params=["as it is", "as a GPU"])
def guarded(request):
    return GuardedDevice(is_cpu=request.param == "as it is" and Device().is_cpu)


def test_the_guard_sees_a_write_beyond_the_end():
    device = GuardedDevice(is_cpu=Device().is_cpu)
    array = device.upload("x", np.zeros(3))
    assert device.overwritten() == set()
    cl.enqueue_fill_buffer(device.queue, array.data, np.float32(1), 0, array.nbytes + 4)
    assert device.overwritten() == {"x"}


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_training_stays_within_its_arrays(guarded, tmp_path, strategy):
    """With everything that has a stage of its own; the sizes are no multiples of anything."""
    scene = small_scene(Device())
    options = {"exposure": True, "poses": True, "filter_3d": strategy == "adc", "dropout": 0.2}
    render = replace(CONFIG.render, mode="antialiased" if strategy == "adc" else "classic")
    config = replace(CONFIG, strategy=strategy, iterations=24, max_gaussians=331, render=render, **options)
    edits = {name: replace(getattr(config, name), start=1, every=10) for name in STRATEGIES}
    train(scene, replace(config, **edits), tmp_path, guarded)
    assert len(guarded.guarded) > 100 and guarded.overwritten() == set()


@pytest.mark.parametrize("method", [SmallIngp, SmallPlenoxels, SmallNerf, SmallMipNerf360], ids=lambda m: m.name)
def test_fields_stay_within_their_arrays(guarded, tmp_path, method, monkeypatch):
    """In training, and for an image whose number of pixels is no multiple of anything."""
    monkeypatch.setattr("clsplat.fields.space.STEP", 3**0.5 / 128)  # few samples, as the photos are small
    config = TrainConfig(iterations=3, data=DataConfig(background="white"))
    scene = ball(photos=5, held_out=1, edge=23)
    train_field(scene, method, config, tmp_path, guarded).image(scene.test[0].camera, BACKGROUNDS["white"])
    assert len(guarded.guarded) > 20 and guarded.overwritten() == set()


@pytest.mark.parametrize("n", [1, 7, 63, 65])
@pytest.mark.parametrize("model", ["pinhole", "orthographic", "fisheye"])
def test_rendering_stays_within_its_arrays(guarded, n, model):
    gaussians, camera = synthetic_scene(n, seed=1, width=37, height=21)
    renderer = Renderer(guarded)
    for degree in (0, 1, 3):
        fewer = replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2])
        run = renderer.forward(fewer, replace(camera, model=model), depth=degree == 1)
        v_image = run.image._replace(rgb=guarded.upload("v", np.ones(run.image.rgb.shape)))
        renderer.backward(run, v_image, camera_grad=degree == 3)
        renderer.stages.count_pairs(run.splats, run.bins)
    renderer.stages.removal(run.splats, run.bins, np.zeros(3))
    far = renderer.forward(gaussians, replace(camera, model=model), depth="inverse")
    known = guarded.upload("inverse depths", np.ones(far.image.alpha.shape))
    v_rgb = guarded.upload("v", np.ones((*known.shape, 3)))
    renderer.stages.disparity_loss(far.image.rgb, known, 1.0)
    renderer.stages.disparity_grad(far.image.rgb, known, 1.0, v_rgb)
    assert guarded.overwritten() == set()
