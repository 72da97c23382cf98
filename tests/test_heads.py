"""Stage heads: against the twin and central differences, and at the limit of the exponent."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.field_stages import EXPONENT_MAX
from clsplat.testing import assert_matches, gradcheck


def inputs(samples=301, rays=17):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(rays, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    arrays = rng.normal(size=(samples, 16)), directions, rng.normal(size=(samples, 16)), rng.normal(size=samples)
    arrays += rng.normal(size=(samples, 3)), rng.normal(size=(samples, 32))
    exact = [a.astype(np.float32).astype(np.float64) for a in arrays]
    exact[0][:2, 0] = [20, -20]
    return *exact, rng.integers(0, rays, samples).astype(np.uint32)


def run(stages, features, directions, outputs, v_sigmas, v_colors, v_inputs, rays_of):
    joined = stages("heads_join", features, directions, rays_of)
    sigmas, colors = stages("heads_fwd", features, outputs)
    v_outputs = stages("heads_bwd", colors, v_colors)
    v_features = stages("heads_join_bwd", v_inputs, features, sigmas, v_sigmas)
    return joined, sigmas, colors, v_outputs, v_features


def by_kernel(device, *given):
    arrays = [device.upload("array", a, None if a.dtype == np.float64 else a.dtype) for a in given]
    results = run(lambda name, *a: getattr(ops, name)(device, *a), *arrays)
    return [a.get() for a in results]


def by_twin(*given):
    return run(lambda name, *a: getattr(reference, name)(*a), *given)


@pytest.mark.parametrize("samples", [1, 301])
def test_matches_twin(any_device, samples):
    given = inputs(samples) if samples > 1 else [a[:1] if len(a) == 301 else a for a in inputs()]
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    names = ("joined", "sigmas", "sample colours", "v_outputs", "v_features")
    for name, found, expected in zip(names, by_kernel(any_device, *given), by_twin(*given), strict=True):
        assert_matches(name, found, expected, tolerances)


def test_the_density_is_limited(device64):
    _, sigmas, _, _, v_features = by_kernel(device64, *inputs())
    np.testing.assert_allclose(sigmas[:2], np.exp([EXPONENT_MAX, -EXPONENT_MAX]))
    np.testing.assert_array_equal(v_features[:2, 0], inputs()[5][:2, 16])  # nothing from the density


def test_gradients_by_central_differences(device64):
    features, directions, outputs, v_sigmas, v_colors, v_inputs, rays_of = inputs(60)
    features[:2] = 0.5
    given = features, directions, outputs, v_sigmas, v_colors, v_inputs, rays_of
    *_, v_outputs, v_features = by_kernel(device64, *given)

    def total(features, outputs):
        joined, sigmas, colors, *_ = by_kernel(device64, features, directions, outputs, *given[3:])
        return float((joined * v_inputs).sum() + sigmas @ v_sigmas + (colors * v_colors).sum())

    gradcheck(total, {"features": features, "outputs": outputs}, {"features": v_features, "outputs": v_outputs})


SCALE = 7.0


def harmonics(samples=301, width=28):
    """Features of Plenoxels, with densities and colours on both sides of 0, and what `inputs` has besides."""
    _, directions, _, v_sigmas, v_colors, _, rays_of = inputs(samples)
    features = np.random.default_rng(1).normal(size=(samples, width)).astype(np.float32).astype(np.float64)
    return features, directions, rays_of, v_sigmas, v_colors


def sh_by_kernel(device, features, directions, rays_of, v_sigmas, v_colors):
    x, d, v_s, v_c = (device.upload("array", a) for a in (features, directions, v_sigmas, v_colors))
    rays = device.upload("rays", rays_of, np.uint32)
    results = [*ops.heads_sh_fwd(device, x, d, rays, SCALE), ops.heads_sh_bwd(device, x, d, rays, SCALE, v_s, v_c)]
    return [a.get() for a in results]


@pytest.mark.parametrize("width", [4, 28])
def test_harmonics_match_twin(any_device, width):
    features, directions, rays_of, v_sigmas, v_colors = given = harmonics(width=width)
    sigmas, colors = reference.heads_sh_fwd(features, directions, rays_of, SCALE)
    assert (sigmas == 0).any() and (colors == 0).any() and (colors > 0).any()
    v_features = reference.heads_sh_bwd(features, directions, rays_of, SCALE, v_sigmas, v_colors)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    found = sh_by_kernel(any_device, *given)
    for name, array, expected in zip(
        ("sigmas", "sample colours", "v_features"), found, (sigmas, colors, v_features), strict=True
    ):
        assert_matches(name, array, expected, tolerances)


@pytest.mark.parametrize("width", [4, 28])
def test_gradients_of_harmonics_by_central_differences(device64, width):
    features, *rest = harmonics(40, width)
    *_, v_sigmas, v_colors = rest

    def total(features):
        sigmas, colors, _ = sh_by_kernel(device64, features, *rest)
        return float(sigmas @ v_sigmas + (colors * v_colors).sum())

    gradcheck(total, {"features": features}, {"features": sh_by_kernel(device64, features, *rest)[2]})


def test_harmonics_of_degree_0_do_not_depend_on_the_direction(device64):
    """c = 1/2 + f / (2 sqrt(pi)), at least 0."""
    features, *rest = harmonics(width=4)
    expected = np.maximum(0.5 + features[:, 1:] / (2 * np.sqrt(np.pi)), 0)
    np.testing.assert_allclose(sh_by_kernel(device64, features, *rest)[1], expected, rtol=1e-12)


def soft_by_kernel(device, features, outputs, v_sigmas, v_features):
    x, y, v_s, v_x = (device.upload("array", a) for a in (features, outputs, v_sigmas, v_features))
    results = ops.heads_soft_fwd(device, x, y, SCALE)
    ops.heads_soft_bwd(device, x, SCALE, v_s, v_x)
    return [a.get() for a in (*results, v_x)]


def test_soft_densities_match_twin(any_device):
    """Also far from 0 on both sides, where the softplus is 0 or the feature itself."""
    features, _, outputs, v_sigmas, _, v_joined, _ = inputs()
    features, v_features = v_joined.copy(), v_joined[::-1].copy()
    features[:2, 0] = [200, -200]
    sigmas, colors = reference.heads_soft_fwd(features, outputs, SCALE)
    np.testing.assert_allclose(sigmas[:2], [199 * SCALE, 0], atol=1e-80)
    expected = v_features.copy()
    reference.heads_soft_bwd(features, SCALE, v_sigmas, expected)
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    found = soft_by_kernel(any_device, features, outputs, v_sigmas, v_features)
    for name, array, wanted in zip(
        ("sigmas", "sample colours", "v_features"), found, (sigmas, colors, expected), strict=True
    ):
        assert_matches(name, array, wanted, tolerances)


def test_gradients_of_soft_densities_by_central_differences(device64):
    features, _, outputs, v_sigmas, *_ = inputs(40)
    features[:2, 0] = 0.5

    def total(features):
        return float(soft_by_kernel(device64, features, outputs, v_sigmas, features)[0] @ v_sigmas)

    v_features = soft_by_kernel(device64, features, outputs, v_sigmas, 0 * features)[2]
    gradcheck(total, {"features": features}, {"features": v_features})
