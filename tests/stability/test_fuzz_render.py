"""Scenes and cameras with extreme values: images and gradients are finite, or there is an InputError, but no crash.

Single values or whole fields of a random scene are replaced by values that a diverged training, a converter or an
attacker may produce (Brush's fuzz tests; Faster-GS). `make fuzz-cases` runs the same test with many more cases.
"""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.render import render

VALUES = [
    *(np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 1e-45, -1e-40, 1.2e-38, 3.4e38, -3.4e38, 1e38, 1e30, -1e30),
    *(1e19, -1e19, 1e10, 1e-10, 1e-19, 1e-30, 1 / 255, 20.0, -20.0, 88.0, -88.0, 100.0, -104.0, 0.0099, 0.01, 1e4),
]
SIZES = [(1, 1), (4099, 3), (2, 257), (16, 16), (37, 29), (8, 1)]
# The second size has so many pixels that only few cases draw it.
MOST = st.sampled_from([*SIZES[:1], *SIZES[2:]])
FIELDS = ("means", "log_scales", "quats", "logit_opacities", "sh")

poisons = st.lists(
    st.tuples(st.sampled_from(FIELDS), st.integers(0, 2**16), st.sampled_from(VALUES), st.booleans()), max_size=4
)
cameras = st.fixed_dictionaries(
    {
        "size": st.one_of(MOST, MOST, MOST, st.just(SIZES[1])),
        "focal": st.sampled_from([1.0, 1.0, 1.0, 1e-38, 1e-6, 1e-3, 1e3, 1e6, 1e20, 3e38]),
        "centre": st.sampled_from([0.5, 0.5, 0.5, -10.0, 1e6, -1e20, 3e38]),
        "distance": st.sampled_from([4.0, 4.0, 4.0, 0.0, 0.01, 1e-6, 1e6, -1e20, 3e38]),
    }
)


def scene_of(n, seed, poisoned, together):
    rng = np.random.default_rng(seed)
    gaussians = Gaussians(
        means=np.zeros((n, 3)) if together else rng.normal(size=(n, 3)),
        log_scales=rng.normal(-2, 1, (n, 3)),
        quats=rng.normal(size=(n, 4)),
        logit_opacities=rng.normal(0, 3, n),
        sh=rng.normal(size=(n, 4, 3)),
    ).astype(np.float32)
    for field, place, value, whole in poisoned:
        flat = getattr(gaussians, field).reshape(-1)
        if whole:
            flat[:] = value
        elif flat.size:
            flat[place % flat.size] = value
    return gaussians


def camera_of(size, focal, centre, distance):
    width, height = size
    viewmat = np.eye(4)
    viewmat[2, 3] = distance
    return Camera(viewmat, focal * width, focal * width, centre * width, centre * height, width, height)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
@pytest.mark.parametrize("sort", ["auto", "pixel"])
def test_images_and_gradients_are_finite(device, cases, mode, sort):
    @given(st.sampled_from([0, 1, 2, 5, 40]), st.integers(0, 99), poisons, st.booleans(), cameras)
    def check(n, seed, poisoned, together, view):
        cases["scenes and cameras"] += 1
        gaussians = scene_of(n, seed, poisoned, together)
        try:
            camera = camera_of(**view)
        except InputError:
            return
        depth = sort == "auto"
        rendering = render(gaussians, camera, RenderConfig(mode=mode, sort=sort), device, depth=depth)
        assert np.isfinite(rendering.rgb).all() and np.isfinite(rendering.alpha).all()
        assert rendering.depth is None or np.isfinite(rendering.depth).all()
        rng = np.random.default_rng(seed)
        v_rgb = rng.normal(size=rendering.rgb.shape).astype(np.float32)
        gradients = rendering.backward(v_rgb, viewmat_grad=True)
        for name, array in gradients.gaussians.arrays().items():
            assert np.isfinite(array).all(), name
        assert np.isfinite(gradients.means2d).all()
        assert gradients.viewmat is not None and np.isfinite(gradients.viewmat).all()

    check()


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_the_other_gaussians_are_drawn_as_before(device, cases, mode):
    """A Gaussian with a NaN is not drawn, and no other pixel changes."""

    @given(
        st.integers(0, 99),
        st.lists(st.tuples(st.sampled_from(FIELDS), st.integers(0, 2**16)), min_size=1, max_size=3),
    )
    def check(seed, places):
        cases["scenes with NaN"] += 1
        gaussians = scene_of(40, seed, [(field, place, np.nan, False) for field, place in places], False)
        whole = np.ones(40, bool)
        for array in gaussians.arrays().values():
            whole &= np.isfinite(array.reshape(40, -1)).all(axis=1)
        camera = camera_of((37, 29), 1.0, 0.5, 4.0)
        config = RenderConfig(mode=mode)
        found = render(gaussians, camera, config, device, gradients=False)
        expected = render(gaussians.take(whole), camera, config, device, gradients=False)
        np.testing.assert_array_equal(found.rgb, expected.rgb)
        np.testing.assert_array_equal(found.alpha, expected.alpha)

    check()


@pytest.mark.parametrize("size", [(0, 1), (1, 0), (-1, 5)])
def test_images_without_pixels_are_refused(size):
    with pytest.raises(InputError, match="size of at least 1x1"):
        Camera(np.eye(4), 1.0, 1.0, 0.0, 0.0, *size)
