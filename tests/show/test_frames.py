"""Pictures of the viewer: normals, comparison with a photo, a page that waits, videos."""

import io
from dataclasses import replace

import numpy as np
import pytest
from small_scenes import cameras

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.metrics import to_uint8
from clsplat.ops import count_pairs
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.show.frames import MODES, Look, colored_normals, normals, picture, scaled_depth, splash
from clsplat.show.viewer_photos import blended
from clsplat.show.viewer_recording import encoder


def plane(camera, normal, distance):
    """Depth map of the plane with points p where normal . p = distance, in camera coordinates."""
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    return distance / (normal[0] * x + normal[1] * y[:, None] + normal[2])


@pytest.mark.parametrize("normal", [(0, 0, -1), (0.6, 0, -0.8), (0, -0.6, -0.8)])
def test_normals_of_planes_point_to_the_camera(normal):
    camera = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), 100, 40, 30)
    found = normals(plane(camera, normal, -5.0), camera)
    np.testing.assert_allclose(found, np.broadcast_to(normal, found.shape), atol=1e-9)


def test_colours_of_normals_in_the_world_are_those_of_the_camera():
    """Red to the right, green up, blue to the camera, which looks along x; black where there is none."""
    camera = Camera.look_at((0, 0, 0), (1, 0, 0), (0, 0, 1), 100, 4, 1)
    found = colored_normals(np.array([[[0, -1, 0], [0, 0, 1], [-1, 0, 0], [0, 0, 0]]]), camera)
    np.testing.assert_array_equal(found, [[[255, 128, 128], [128, 255, 128], [128, 128, 255], [0, 0, 0]]])
    np.testing.assert_array_equal(scaled_depth(np.array([[0.0, -1.0, 1.0, 4.0]])), [[0, 0, 16384, 65535]])


def test_a_surface_to_the_camera_is_blue(device):
    gaussians, (camera, *_) = cameras()
    gaussians.means[:, 2] *= 0.001
    gaussians.log_scales[:] = np.log(0.3)
    gaussians.logit_opacities[:] = 5
    frame, legend = picture(Renderer(device), gaussians, camera, Look("normals"))
    middle = frame[100:140, 140:180].reshape(-1, 3).mean(axis=0)
    assert middle[2] > 200 and "blue to the camera" in legend
    assert normals(np.ones((1, 5)), camera).shape == (1, 5, 3)


def test_the_sky_does_not_take_the_colours_of_depths(device):
    gaussians, (camera, *_) = cameras()
    gaussians.logit_opacities[:] = 5
    sky = gaussians.take(np.zeros(1, int))
    sky.means[0] = camera.position + 3000 * camera.viewmat[2, :3]
    sky.log_scales[:] = np.log(3000)
    scene = Gaussians.concatenate([gaussians, sky])
    legend = picture(Renderer(device), scene, camera, Look("depth"))[1]
    assert float(legend.split()[3]) < 100


def test_background_and_degree_change_the_render(device):
    gaussians, (camera, *_) = cameras()
    renderer = Renderer(device, background=(0.0, 0.0, 0.0))
    plain = picture(renderer, gaussians, camera)[0]
    assert (
        np.abs(plain.astype(int) - picture(renderer, gaussians, camera, Look(MODES[0], (0.0, 1.0, 0.0)))[0]).max()
        > 100
    )
    assert gaussians.sh_degree > 0
    assert (plain != picture(renderer, gaussians, camera, Look(sh_degree=0))[0]).any()
    np.testing.assert_array_equal(plain, picture(renderer, gaussians, camera, Look(sh_degree=9))[0])


class TestComparison:
    """A photo of 200x100 in a window of 300x300 with twice the focal length of the photo."""

    photo = Camera.look_at((0, 0, 0), (0, 0, 1), (0, -1, 0), 100, 200, 100)
    window = replace(photo, fx=200, fy=200, cx=150, cy=150, width=300, height=300)

    def test_each_pixel_shows_what_is_in_its_direction(self):
        rng = np.random.default_rng(1)
        smooth = np.kron(rng.integers(0, 255, (5, 10, 3)), np.ones((20, 20, 1))).astype(np.uint8)
        found = blended(np.zeros((300, 300, 3), np.uint8), self.window, smooth, self.photo, "overlay", 1.0)
        for u, v in ((10, 140), (290, 60), (150, 150), (77, 222)):
            x = (u + 0.5 - 150) / 200 * 100 + 100
            y = (v + 0.5 - 150) / 200 * 100 + 50
            if 10 < x % 20 < 15 and 10 < y % 20 < 15:
                np.testing.assert_allclose(found[v, u], smooth[int(y), int(x)], atol=1)
        # The photo covers 100 px of height of 50 at twice the scale: rows 50 to 250.
        assert not found[:49].any() and not found[251:].any() and found[60:240].any(axis=(1, 2)).all()

    def test_overlay_mixes_and_beside_divides(self):
        white, black = np.full((100, 200, 3), 255, np.uint8), np.zeros((300, 300, 3), np.uint8)
        mixed = blended(black, self.window, white, self.photo, "overlay", 0.4)
        assert (mixed[60:240] == 102).all() and not mixed[:49].any()
        beside = blended(black, self.window, white, self.photo, "beside", 0.5)
        assert (beside[60:240, :149] == 255).all() and not beside[60:240, 152:].any()
        assert (beside[:, 149:151] == 255).all(), "a line between the two"


def test_a_page_that_waits_shows_a_sentence():
    frame = splash("compiling kernels", 4000, 1000)
    assert frame.shape == (320, 1280, 3)
    text = np.argwhere(frame[:, :, 0] > 120)
    assert 100 < len(text) and np.abs(text.mean(axis=0) - (160, 640)).max() < 20
    assert splash("x", 1, 3).shape == (3, 1, 3)


def test_a_video_has_its_frames():
    av = pytest.importorskip("av", reason="PyAV, the extra `video`, is missing")
    frames = [np.full((32, 48, 3), 60 * k, np.uint8) for k in range(4)]
    file = io.BytesIO()
    with encoder(file, 48, 32) as encode:
        for frame in frames:
            encode(frame)
    with av.open(io.BytesIO(file.getvalue())) as container:
        found = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert [f.shape for f in found] == [(32, 48, 3)] * 4
    np.testing.assert_allclose([f.mean() for f in found], [0, 60, 120, 180], atol=4)


def test_without_av_a_video_is_a_sentence(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(InputError, match=r"pip install 'clsplat\[video\]'"), encoder(io.BytesIO(), 2, 2):
        pass


class TestPicture:
    def test_render_is_the_image_of_render(self, device):
        gaussians, (camera, *_) = cameras()
        frame, legend = picture(Renderer(device, background=(1.0, 0.0, 0.5)), gaussians, camera)
        ours = render(gaussians, camera, device=device, background=(1.0, 0.0, 0.5))
        np.testing.assert_array_equal(frame, to_uint8(ours.rgb))
        assert legend == ""

    def test_depth_alpha_and_count_and_their_legends(self, device):
        gaussians, (camera, *_) = cameras()
        gaussians.logit_opacities[:] = 4
        ours = render(gaussians, camera, device=device, depth=True)
        shown = {
            mode: picture(Renderer(device, background=(0.0, 0.0, 0.0)), gaussians, camera, Look(mode))
            for mode in MODES
        }
        alpha = np.repeat(ours.alpha[:, :, None], 3, axis=2)
        np.testing.assert_array_equal(shown["alpha"][0], to_uint8(alpha))
        solid = ours.alpha > 0.5
        assert 0 < solid.mean() < 1
        assert not shown["depth"][0][~solid].any()
        brightness = shown["depth"][0].sum(axis=2)[solid].astype(float)
        assert np.corrcoef(brightness, ours.depth[solid])[0, 1] < -0.8, "near must be bright"
        near, far = np.percentile(ours.depth[solid], [2, 98])
        assert f"bright {near:.3g}, dark {far:.3g}" in shown["depth"][1]
        run = Renderer(device).forward(gaussians, camera, 0, gradients=False)
        count = count_pairs(device, run.splats, run.bins)[1].get()
        assert f"bright {count.max()} Gaussians per pixel; mean {count.mean():.1f}" in shown["count"][1]
        order = np.argsort(count, axis=None)[[0, -1]]
        darkest, brightest = shown["count"][0].sum(axis=2).ravel()[order]
        assert darkest < brightest == shown["count"][0].sum(axis=2).max()

    def test_an_empty_view_has_no_depth(self, device):
        gaussians, (camera, *_) = cameras()
        gaussians.logit_opacities[:] = -20
        frame, legend = picture(Renderer(device, background=(1.0, 1.0, 1.0)), gaussians, camera, Look("depth"))
        assert not frame.any()
        assert legend == "nothing opaque in view"
