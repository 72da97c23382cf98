"""Rendering without gradients: the same images, one upload, nothing kept."""

import numpy as np
import pytest

from clsplat import reference
from clsplat.config import RenderConfig
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import SHAPES
from clsplat.render import render, render_views
from clsplat.testing import synthetic_scene

BACKGROUND = (0.2, 0.5, 0.9)


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(150, 6, width=53, height=38)


class TestForwardOnly:
    """Pictures without gradients: the same bits, nothing kept on the device, one upload for all views."""

    @pytest.fixture
    def cameras(self):
        _, camera = synthetic_scene(1, 7)
        moved = [camera.translated(np.array([d, 0.1, 0.0])) for d in (0.0, 0.2, 0.4)]
        return [*moved, camera.resized(31, 40)]

    @pytest.mark.parametrize("twin", [True, False], ids=["twin", "device"])
    def test_views_are_what_render_gives(self, device, scene, cameras, twin):
        gaussians, target = scene[0], "reference" if twin else device
        options = {"background": BACKGROUND, "depth": True, "sh_degree": 1}
        views = list(render_views(gaussians, cameras, RenderConfig("antialiased"), target, **options))
        assert len(views) == len(cameras)
        for view, camera in zip(views, cameras, strict=True):
            expected = render(gaussians, camera, RenderConfig("antialiased"), target, **options)
            for name in ("rgb", "alpha", "depth"):
                np.testing.assert_array_equal(getattr(view, name), getattr(expected, name), err_msg=name)

    def test_gaussians_are_uploaded_once(self, device, scene, cameras, monkeypatch):
        uploads = []
        upload = Device.upload
        monkeypatch.setattr(Device, "upload", lambda self, what, *a: uploads.append(what) or upload(self, what, *a))
        list(render_views(scene[0], cameras, RenderConfig(), device))
        assert [uploads.count(name) for name in SHAPES] == [1] * len(SHAPES)

    def test_lists_are_made_without_what_gradients_need(self, scene, cameras, monkeypatch):
        asked = []
        bin_splats = reference.bin_splats
        monkeypatch.setattr(
            reference, "bin_splats", lambda *a, gradients=True, **k: asked.append(gradients) or bin_splats(*a, **k)
        )
        list(render_views(scene[0], cameras, device="reference"))
        render(*scene, gradients=False, device="reference")
        render(*scene, device="reference")
        assert asked == [False] * (len(cameras) + 1) + [True]

    def test_cameras_are_asked_for_one_by_one(self, device, scene, cameras):
        asked = []
        views = render_views(scene[0], (asked.append(c) or c for c in cameras), RenderConfig(), device)
        next(views)
        assert len(asked) == 1

    def test_nothing_stays_on_the_device(self, scene):
        device = Device()
        rendering = render(*scene, RenderConfig(), device, gradients=False)
        assert device.buffers.pool.active_blocks == 1  # the background
        kept = render(*scene, RenderConfig(), device)
        assert device.buffers.pool.active_blocks > 1
        np.testing.assert_array_equal(rendering.rgb, kept.rgb)

    def test_backward_refuses(self, device, scene, cameras):
        rendering = next(render_views(scene[0], cameras, RenderConfig(), device))
        with pytest.raises(InputError, match="gradients: expected a rendering made with gradients=True"):
            rendering.backward(rendering.rgb)

    def test_bad_input_is_refused_at_once(self, scene, cameras):
        with pytest.raises(InputError, match="sh_degree"):
            render_views(scene[0], cameras, sh_degree=4, device="reference")

    def test_no_gaussians(self, device, cameras):
        for view, camera in zip(render_views(synthetic_scene(0)[0], cameras, device=device), cameras, strict=True):
            assert view.rgb.shape == (camera.height, camera.width, 3) and (view.rgb == 0).all()
