"""Stage adam: the twin against its definition, one number at a time; the kernel against the twin, at the borders of
its runs, on bands that are not trained and on gradients that should not come."""

import numpy as np
import pytest
from tolerances import DOUBLE, FLOAT

from clsplat import ops, reference
from clsplat.config import OptimConfig
from clsplat.gaussians import SHAPES, Gaussians, sigmoid
from clsplat.reference.adam import BLOCK
from clsplat.renderer import Renderer, fetch
from clsplat.stages import ERANK_SLACK
from clsplat.testing import assert_matches, gradcheck, synthetic_scene
from clsplat.training.optimizer import Moments, adam_settings

CONFIG = OptimConfig()
STEPS = 100
# A CPU's runs are 64 values: less than one; ends on both sides of one for widths 3 (21 and 22 rows), 4 and 1; many.
COUNTS = [1, 5, 21, 22, 64, 65, 1000]


def settings(t, sh_degree=3):
    return adam_settings(t, t / STEPS, 2.0, CONFIG, sh_degree)


def start_of(n, *, sh_degree=3):
    """Parameters and moments of zeros, exact in single precision."""
    start = synthetic_scene(n, seed=n, sh_degree=sh_degree)[0].astype(np.float32).astype(np.float64)
    return start, *vars(Moments.zeros(start)).values()


def random_like(gaussians, rng):
    """Gradients that change sign and size, as those of a Gaussian that some photos see and others do not; exact in
    single precision."""
    shapes = {name: array.shape for name, array in gaussians.arrays().items()}
    arrays = {name: rng.normal(size=s) * 10.0 ** rng.uniform(-6, 1, s) for name, s in shapes.items()}
    return Gaussians(**arrays).astype(np.float32).astype(np.float64)


def by_twin(state, gradients, sh_degree):
    """Parameters and both moments after one step for each of the gradients."""
    state = [part.astype(np.float64) for part in state]
    for t, gradient in enumerate(gradients, start=1):
        reference.adam_step(state[0], gradient, *state[1:], settings(t, sh_degree))
    return state


def by_kernel(device, state, gradients, sh_degree):
    """As `by_twin`."""
    state = [Renderer(device).place(part) for part in state]
    for t, gradient in enumerate(gradients, start=1):
        ops.adam_step(device, state[0], Renderer(device).place(gradient), *state[1:], settings(t, sh_degree))
    return [fetch(part) for part in state]


def check(device, state, gradients, sh_degree, *, compare_moments=True):
    tolerances = DOUBLE if device.real == np.float64 else FLOAT
    quantities = ("parameters", "first moments", "second moments")[: 3 if compare_moments else 1]
    found, expected = by_kernel(device, state, gradients, sh_degree), by_twin(state, gradients, sh_degree)
    for quantity, a, b in zip(quantities, found, expected, strict=False):
        for name in SHAPES:
            assert_matches(quantity, getattr(a, name), getattr(b, name), tolerances)


def assert_same_bits(actual, expected):
    for a, b in zip(actual, expected, strict=True):
        for name in SHAPES:
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


def scalar_adam(p, gradients, name):
    """Algorithm 1 of Kingma and Ba 2015, written for one number."""
    m = v = 0.0
    for t, g in enumerate(gradients, start=1):
        m = CONFIG.beta1 * m + (1 - CONFIG.beta1) * g
        v = CONFIG.beta2 * v + (1 - CONFIG.beta2) * g * g
        m_hat, v_hat = m / (1 - CONFIG.beta1**t), v / (1 - CONFIG.beta2**t)
        p -= settings(t).rates[name] * m_hat / (v_hat**0.5 + CONFIG.eps)
    return p


def test_twin_follows_the_definition():
    # More rows than one block of the widest field, so that block borders are crossed.
    n = BLOCK // 48 + 3
    state, rng = start_of(n), np.random.default_rng(0)
    gradients = [random_like(state[0], rng) for _ in range(3)]
    trained = by_twin(state, gradients, 3)[0]
    for name in SHAPES:
        p, found, *g = (getattr(part, name).reshape(n, -1) for part in (state[0], trained, *gradients))
        for row, column in [(0, 0), (n - 1, 0), (n - 1, p.shape[1] - 1), (BLOCK // 48, 0)]:
            rate = name if name != "sh" else "sh0" if column < 3 else "sh_rest"
            expected = scalar_adam(p[row, column], [v[row, column] for v in g], rate)
            assert found[row, column] == pytest.approx(expected, rel=1e-12), (name, row, column)


@pytest.mark.parametrize("n", COUNTS)
def test_matches_twin(any_device, n):
    state, rng = start_of(n), np.random.default_rng(n)
    check(any_device, state, [random_like(state[0], rng) for _ in range(STEPS)], 3)


@pytest.mark.parametrize("n", COUNTS)
def test_matches_twin_as_cpu_and_gpu(configured_device, n):
    state, rng = start_of(n), np.random.default_rng(n)
    check(configured_device, state, [random_like(state[0], rng) for _ in range(3)], 3)


@pytest.mark.parametrize("stored", [0, 1, 2, 3])
def test_matches_twin_at_each_degree(any_device, stored):
    state, rng = start_of(22, sh_degree=stored), np.random.default_rng(0)
    gradients = [random_like(state[0], rng) for _ in range(3)]
    for sh_degree in range(stored + 1):
        check(any_device, state, gradients, sh_degree)


@pytest.mark.parametrize("sh_degree", [0, 1, 2])
def test_bands_that_are_not_trained_do_not_move(configured_device, sh_degree):
    start, rng = start_of(22)[0].astype(np.float32), np.random.default_rng(0)
    # Moments that would move them.
    first, second = (random_like(start, rng).astype(np.float32) for _ in range(2))
    second = Gaussians(**{name: array**2 for name, array in second.arrays().items()})
    state, gradients = (start, first, second), [random_like(start, rng)]
    trained = (sh_degree + 1) ** 2
    for after in (by_kernel(configured_device, state, gradients, sh_degree), by_twin(state, gradients, sh_degree)):
        for a, b in zip(after, state, strict=True):
            assert (a.sh[:, trained:] == b.sh[:, trained:]).all()
            # Single precision rounds some of the smallest steps away.
            assert (a.sh[:, :trained] != b.sh[:, :trained]).mean() > 0.9


def test_rates_act_where_they_should(any_device):
    """The first step is the rate, towards the side where the loss falls."""
    state, rng = start_of(65), np.random.default_rng(0)
    state[0].sh[:] = state[0].means[:] = 0  # nothing to round a small step to
    gradients = [random_like(state[0], rng)]
    rates = settings(1).rates
    assert len(set(rates.values())) == len(rates)
    for after in (by_kernel(any_device, state, gradients, 3)[0], by_twin(state, gradients, 3)[0]):
        for name in SHAPES:
            moved = np.sign(getattr(gradients[0], name)) * (getattr(state[0], name) - getattr(after, name))
            parts = {name: moved} if name != "sh" else {"sh0": moved[:, :1], "sh_rest": moved[:, 1:]}
            for rate, part in parts.items():
                # Single precision: parameters of up to 4, and steps of 1e-3.
                np.testing.assert_allclose(part, rates[rate], rtol=5e-4, err_msg=rate)


def test_penalties_are_gradients_of_sums(any_device):
    """What the first moments take in, by finite differences of the penalty itself; opacities near 0 and 1 too."""
    weights = 0.3, 0.7, 0.5
    gaussians, zeros, second = start_of(23)
    gaussians.logit_opacities[:3] = -30, 30, 0
    gaussians.log_scales[:6] = [(0, -4, -5), (-3, 0, 0), (0, 0, 0), (-9, -3, -4), (-1, -8, -1.5), (-2, -2, -12)]

    def penalty(log_scales, logit_opacities):
        q = np.exp(2 * log_scales) / np.exp(2 * log_scales).sum(axis=1, keepdims=True)
        erank = np.exp(-(q * np.log(q)).sum(axis=1))
        needles = np.maximum(-np.log(erank - 1 + ERANK_SLACK), 0).sum()
        return (
            weights[0] * sigmoid(logit_opacities).sum() + weights[1] * np.exp(log_scales).sum() + weights[2] * needles
        )

    def moments(add):
        step = settings(1)._replace(penalties=weights)
        return {name: array / (1 - CONFIG.beta1) for name, array in add(step).arrays().items()}

    def twin(step):
        state = [part.astype(np.float64) for part in (gaussians, zeros, zeros, second)]
        reference.adam_step(*state, step)
        return state[2]

    def kernel(step):
        state = [Renderer(any_device).place(part) for part in (gaussians, zeros, zeros, second)]
        ops.adam_step(any_device, *state, step)
        return fetch(state[2])

    expected, found = moments(twin), moments(kernel)
    inputs = {name: getattr(gaussians, name) for name in ("log_scales", "logit_opacities")}
    gradcheck(penalty, inputs, {name: expected[name] for name in inputs})
    tolerances = DOUBLE if any_device.real == np.float64 else FLOAT
    for name in SHAPES:
        assert_matches("first moments", found[name], expected[name], tolerances)
        assert name in inputs or not expected[name].any()


def test_no_gradient_no_step(any_device):
    state = [part.astype(any_device.real) for part in start_of(22)]
    zeros = [state[1]] * 3
    assert_same_bits(by_kernel(any_device, state, zeros, 3), state)
    twin = [part.astype(np.float64) for part in state]
    assert_same_bits(by_twin(twin, zeros, 3), twin)


@pytest.mark.parametrize("size", [1e-40, 1e-25, 1e-16, 1e18])
def test_tiny_and_huge_gradients(any_device, size):
    """Squares that underflow, where eps is larger than their root, and the largest that do not overflow."""
    state, rng = start_of(22), np.random.default_rng(0)
    gradient = random_like(state[0], rng)
    for array in gradient.arrays().values():
        array[:] = np.sign(array) * size
    # Zeros at the end: what the moments alone do.
    check(any_device, state, [gradient, gradient, state[1]], 3, compare_moments=size > 1e-20)


@pytest.mark.parametrize("size", [0.0, 1e-45, 1e-40, 1e-22, 1e18, 1e20, 3e38])
def test_parameters_stay_finite(configured_device, size):
    """Also where the square of a gradient is beyond single precision; then that parameter rests."""
    state, rng = start_of(22), np.random.default_rng(0)
    gradients = [random_like(state[0], rng) for _ in range(6)]
    for gradient in gradients[1:4]:
        for array in gradient.arrays().values():
            array[::2] = np.sign(array[::2]) * size
    after, first, _ = by_kernel(configured_device, state, gradients, 3)
    largest = STEPS * max(settings(1).rates.values())  # far above the sum of six steps
    for name in SHAPES:
        assert np.isfinite(getattr(first, name)).all(), name
        assert np.abs(getattr(after, name) - getattr(state[0], name)).max() < largest, name


def test_same_bits_twice(configured_device):
    state, rng = start_of(1000), np.random.default_rng(0)
    gradients = [random_like(state[0], rng) for _ in range(3)]
    assert_same_bits(*(by_kernel(configured_device, state, gradients, 2) for _ in range(2)))


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("size", [1, 16, 100, 5000])
def test_an_array_matches_twin(any_device, configured_device, size, sparse):
    """Gradients with zeros, alone and in whole vectors; with `sparse` nothing moves there."""
    for device in (any_device, configured_device):
        rng = np.random.default_rng(size)
        start = [rng.normal(size=size) for _ in range(2)] + [rng.uniform(size=size)]
        p, m, v = (a.astype(np.float32).astype(np.float64) for a in start)
        twin = [a.copy() for a in (p, m, v)]
        arrays = [device.upload("array", a) for a in (p, m, v)]
        for iteration in range(1, 4):
            g = rng.normal(size=size).astype(np.float32).astype(np.float64)
            g[rng.uniform(size=size) < 0.5] = 0
            g[size // 4 : size // 2] = 0
            step = settings(iteration)
            ops.adam_array(device, arrays[0], device.upload("g", g), *arrays[1:], 1e-2, step, sparse=sparse)
            reference.adam_array(twin[0], g, *twin[1:], 1e-2, step, sparse=sparse)
        tolerances = DOUBLE if device.real == np.float64 else FLOAT
        for name, found, wanted in zip(("parameters", "first moments", "second moments"), arrays, twin, strict=True):
            assert_matches(name, found.get(), wanted, tolerances)
        if sparse:
            still = slice(size // 4, size // 2)
            np.testing.assert_array_equal(arrays[0].get()[still], p[still].astype(device.real))
