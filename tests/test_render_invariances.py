"""The renderer: what must not change the image."""

from dataclasses import replace

import numpy as np
import pytest
from test_render import BACKGROUND, COMPOSITORS, FIELDS, MODES, images, random_grads, turned
from tolerances import DOUBLE

from clsplat import reference
from clsplat.config import RenderConfig
from clsplat.gaussians import logit
from clsplat.render import render
from clsplat.testing import assert_matches, synthetic_scene


@pytest.fixture(scope="module")
def scene():
    return synthetic_scene(150, 6, width=53, height=38)


class TestInvariances:
    def test_same_bits_twice(self, device, scene):
        first, second = (render(*scene, RenderConfig("antialiased"), device, depth=True) for _ in range(2))
        for a, b in zip(images(first), images(second), strict=True):
            np.testing.assert_array_equal(a, b)
        v_images = random_grads(first)
        v, w = (r.backward(*v_images, viewmat_grad=True) for r in (first, second))
        for name, array in v.gaussians.arrays().items():
            np.testing.assert_array_equal(array, w.gaussians.arrays()[name], err_msg=name)
        np.testing.assert_array_equal(v.means2d, w.means2d)
        np.testing.assert_array_equal(v.viewmat, w.viewmat)

    def test_sort(self, device, scene):
        """To the bit: the lists are the same."""
        images = [render(*scene, RenderConfig(sort=sort), device).rgb for sort in ("auto", "global", "per_tile")]
        np.testing.assert_array_equal(images[1], images[0])
        np.testing.assert_array_equal(images[2], images[0])

    @COMPOSITORS
    def test_tile_size(self, device64, scene, compositor):
        """To rounding, for distances to a pixel count from its tile; test_composite has the case without rounding."""
        renders = [render(*scene, RenderConfig(tile_size=t, compositor=compositor), device64) for t in (8, 16, 32)]
        v_images = random_grads(renders[0])
        first, *others = (r.backward(*v_images).gaussians.arrays() for r in renders)
        for other, v in zip(renders[1:], others, strict=True):
            assert_matches("rgb", other.rgb, renders[0].rgb, DOUBLE)
            for name, array in first.items():
                assert_matches(f"v_{name}", v[name], array, DOUBLE)

    @COMPOSITORS
    def test_tile_size_in_float(self, device, scene, compositor):
        """No band of ambiguous pixels: tilings decide alike but for the last bit of a distance."""
        renders = [render(*scene, RenderConfig(tile_size=t, compositor=compositor), device) for t in (8, 16, 32)]
        for other in renders[1:]:
            flips = np.abs(other.rgb - renders[0].rgb).max(axis=2) > 1e-5
            assert flips.mean() < 1e-3

    def test_permutation(self, device, scene):
        gaussians, camera = scene
        order = np.random.default_rng(0).permutation(len(gaussians))
        first, second = (render(g, camera, RenderConfig(), device) for g in (gaussians, gaussians.take(order)))
        np.testing.assert_array_equal(first.rgb, second.rgb)
        v_images = random_grads(first)
        v, w = (r.backward(*v_images) for r in (first, second))
        for name, array in v.gaussians.arrays().items():
            np.testing.assert_array_equal(array[order], w.gaussians.arrays()[name], err_msg=name)

    def test_equal_depths_are_drawn_by_index(self, device):
        """Two Gaussians at one place: the one that comes first is in front."""
        gaussians, camera = synthetic_scene(2, 0, sh_degree=0)
        for array in gaussians.arrays().values():
            array[1] = array[0]
        gaussians.means[:] = 0
        gaussians.logit_opacities[:] = 2
        gaussians.sh[:, 0] = [[1, -1, 0], [-1, 1, 0]]
        rgb = render(gaussians, camera, RenderConfig(), device).rgb[camera.height // 2, camera.width // 2]
        other = render(gaussians.take([1, 0]), camera, RenderConfig(), device).rgb
        assert rgb[0] > 2 * rgb[1]
        np.testing.assert_allclose(other[camera.height // 2, camera.width // 2], rgb[[1, 0, 2]], rtol=1e-6)

    @MODES
    def test_rigid_motion_and_scale_of_the_world(self, device64, mode):
        """Degree 0: the bands of higher degrees would have to turn with the world."""
        gaussians, camera = synthetic_scene(60, 7, sh_degree=0)
        quat = np.array([0.4, -0.2, 0.7, 0.5])
        quat /= np.linalg.norm(quat)
        for moved in (turned(gaussians, camera, quat, [3, -2, 7]), turned(gaussians, camera, quat, [0, 0, 0], 40)):
            expected, actual = (render(*s, RenderConfig(mode), device64) for s in ((gaussians, camera), moved))
            # The norm of a quaternion does not matter either.
            rescaled = render(replace(moved[0], quats=-3 * moved[0].quats), moved[1], RenderConfig(mode), device64)
            for rendering in (actual, rescaled):
                assert_matches("moved world", rendering.rgb, expected.rgb, DOUBLE)

    def test_world_offset(self, device64, scene):
        """A geo-referenced world, 1e6 from its origin: nothing but the digits of float64 is lost."""
        gaussians, camera = scene
        offset = np.array([4.5e6, -1e6, 300.0])
        far = replace(gaussians, means=gaussians.means + offset), camera.translated(-offset)
        expected = render(gaussians, camera, RenderConfig(), device64)
        np.testing.assert_allclose(render(*far, RenderConfig(), device64).rgb, expected.rgb, atol=1e-6)
        back = replace(far[0], means=far[0].means - offset), far[1].translated(offset)
        np.testing.assert_allclose(render(*back, RenderConfig(), device64).rgb, expected.rgb, atol=1e-6)

    def test_compensation_is_a_lower_opacity(self, device64, scene):
        """antialiased draws what classic draws with the opacities that project found."""
        gaussians, camera = scene
        splats = reference.project_fwd(gaussians, camera, 3, antialiased=True)
        plain = reference.project_fwd(gaussians, camera, 3)
        shown = splats.extents[:, 0] > 0
        ratio = splats.opacities[shown] / plain.opacities[shown]
        assert (ratio < 1).all() and ratio.min() < 0.8 and ratio.max() > 0.9
        seen = gaussians.take(shown)
        expected = render(replace(seen, logit_opacities=logit(splats.opacities[shown])), camera, device=device64)
        assert_matches("rgb", render(seen, camera, RenderConfig("antialiased"), device64).rgb, expected.rgb, DOUBLE)

    def test_background_shines_through(self, device, scene):
        black, lit = (render(*scene, RenderConfig(), device, background=b) for b in ((0, 0, 0), BACKGROUND))
        expected = black.rgb + (1 - black.alpha)[:, :, None] * np.array(BACKGROUND)
        np.testing.assert_allclose(lit.rgb, expected, atol=1e-6)

    def test_depth_does_not_change_the_image(self, device, scene):
        plain, deep = (render(*scene, RenderConfig(), device, depth=d) for d in (False, True))
        np.testing.assert_array_equal(plain.rgb, deep.rgb)
        assert plain.depth is None

    def test_configured_as_a_gpu(self, configured_device, device, scene):
        """Sort, scan and compositing as launched on a GPU: the same image up to the order of sums."""
        expected = render(*scene, RenderConfig(), device)
        actual = render(*scene, RenderConfig(), configured_device)
        assert (np.abs(actual.rgb - expected.rgb).max(axis=2) > 1e-5).mean() < 1e-3
        v_images = random_grads(expected)
        v, w = (r.backward(*v_images).gaussians for r in (expected, actual))
        for name in FIELDS:
            a, b = v.arrays()[name], w.arrays()[name]
            assert np.linalg.norm(a - b) < 1e-3 * np.linalg.norm(a), name
