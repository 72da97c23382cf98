"""Difficult cases of projection: invalid parameters, needles, the edge of the frustum, and wide angles."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat import ops, reference
from clsplat.bench.stability.projection import POISONS, _psnr, harm, ray_image, shell, wide_camera
from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.constants import FRUSTUM_MARGIN
from clsplat.gaussians import Gaussians
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene


@pytest.mark.parametrize("field", Gaussians.__dataclass_fields__)
def test_a_poison_harms_no_other_gaussian(device, field):
    """One NaN spreads through its tile, and through the gradients to the whole scene (Brush's fuzz tests)."""
    for k, value in enumerate(POISONS):
        mode = ("classic", "antialiased")[k % 2]
        for sort in ("auto", "pixel"):
            assert harm(device, field, value, RenderConfig(mode=mode, sort=sort)) == "", (value, mode, sort)


def test_needles_keep_their_determinant(device):
    """xx yy - xy^2 cancels: in float32, the determinant of a needle of 1000 px is 0 or negative."""
    gaussians, camera = synthetic_scene(200, width=97, height=61)
    rng = np.random.default_rng(0)
    gaussians.means[:] = rng.uniform(-0.3, 0.3, (200, 3))
    gaussians.log_scales[:] = np.log([40.0, 1e-3, 1e-3])
    needles = gaussians.astype(np.float32)
    found = ops.project_fwd(device, Renderer(device).place(needles), camera, 0)
    expected = reference.project_fwd(needles, camera, 0)
    shown = expected.extents[:, 0] > 1000
    assert shown.sum() > 50, "the needles must be long"
    trace = [(c[:, 0] + c[:, 2])[shown] for c in (found.conics.get(), expected.conics)]
    np.testing.assert_allclose(*trace, rtol=1e-3)


def test_extents_stay_bounded_outside_the_image(any_device):
    """Outside of the frustum, the affine approximation is unbounded (diff-gaussian-rasterization #75).

    Slopes are clamped to the enlarged image, also just behind the near plane.
    """
    camera = Camera(np.eye(4), 50, 50, 50, 50, 100, 100)
    gaussians = replace(synthetic_scene(3)[0], means=np.array([[0, 0, 1.0], [2, 0, 1], [40, 0, 1]]) * 0.0105)
    gaussians.log_scales[:] = np.log(0.5)
    splats = ops.project_fwd(any_device, Renderer(any_device).place(gaussians), camera, 0)
    extents, logits = splats.extents.get()[:, 0], splats.opacities.get()
    r = np.sqrt(2 * np.log(255 * logits))
    expected = np.sqrt(1 + (1 + FRUSTUM_MARGIN) ** 2)
    assert extents[1] / r[1] / (extents[0] / r[0]) == pytest.approx(expected, rel=5e-3)
    assert (extents[2] / r[2] if extents[2] else 0) <= 1.01 * extents[1] / r[1]


def test_the_projection_along_rays_is_right_at_wide_angles(device):
    """The affine projection is accurate at narrow angles, but not at wide ones (3DGUT)."""
    scene, found = shell(150), {}
    for projection in ("affine", "ray"):
        for degrees in (40, 140):
            camera, config = wide_camera(degrees, width=60), RenderConfig(projection=projection)
            rgb = render(scene.astype(np.float32), camera, config, device, gradients=False).rgb
            found[projection, degrees] = _psnr(rgb, ray_image(scene, camera).rgb)
    assert found["affine", 40] > 30 > 25 > found["affine", 140]
    # What is left at 140 degrees is the blur, and Gaussians whose centre is behind the camera's plane.
    assert found["ray", 40] > 40 and found["ray", 140] > found["affine", 140] + 3
