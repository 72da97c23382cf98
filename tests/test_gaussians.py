"""The container of parameters: activations, shapes, selection."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import SHAPES, Gaussians, logit, sigmoid
from clsplat.testing import synthetic_scene


@pytest.fixture
def gaussians():
    return synthetic_scene(5, sh_degree=2)[0].astype(np.float32)


def test_sigmoid_neither_overflows_nor_loses_small_values():
    x = np.array([-1000.0, -100, -1, 0, 1, 100, 1000])
    np.testing.assert_allclose(
        sigmoid(x), [0, np.exp(-100), 1 / (1 + np.e), 0.5, np.e / (1 + np.e), 1, 1], rtol=1e-15
    )
    assert sigmoid(np.float32([0.5])).dtype == np.float32


def test_logit_is_its_inverse():
    p = np.array([1e-12, 0.01, 0.5, 0.99])
    np.testing.assert_allclose(sigmoid(logit(p)), p, rtol=1e-14)


def test_activations(gaussians):
    np.testing.assert_allclose(gaussians.scales, np.exp(gaussians.log_scales))
    np.testing.assert_allclose(gaussians.opacities, 1 / (1 + np.exp(-gaussians.logit_opacities)), rtol=1e-6)


@pytest.mark.parametrize("degree", range(4))
def test_degree(degree):
    assert synthetic_scene(1, sh_degree=degree)[0].validate().sh_degree == degree


def test_length_and_names(gaussians):
    assert len(gaussians) == 5
    assert list(gaussians.arrays()) == list(SHAPES)


@pytest.mark.parametrize("name", SHAPES)
def test_validate_names_the_field(gaussians, name):
    array = getattr(gaussians, name)
    gaussians.validate()
    with pytest.raises(InputError, match=f"^{'log_scales' if name == 'means' else name}: expected shape"):
        replace(gaussians, **{name: array[:-1]}).validate()
    with pytest.raises(InputError, match=f"^{name}: expected shape"):
        replace(gaussians, **{name: array[..., None]}).validate()
    with pytest.raises(InputError, match=f"^{name}: expected float32 or float64, found int64"):
        replace(gaussians, **{name: array.astype(np.int64)}).validate()


@pytest.mark.parametrize("coefficients", [0, 2, 25])
def test_validate_counts_coefficients(gaussians, coefficients):
    with pytest.raises(InputError, match=f"sh: expected 1, 4, 9 or 16 coefficients, found {coefficients}"):
        replace(gaussians, sh=np.zeros((5, coefficients, 3), np.float32)).validate()


def test_astype_copies(gaussians):
    copy = gaussians.astype(np.float32)
    copy.means[0] = 7
    assert not (gaussians.means[0] == 7).any()
    wide = Gaussians(**{k: np.asfortranarray(a) for k, a in gaussians.arrays().items()}).astype(np.float64)
    assert all(a.dtype == np.float64 and a.flags.c_contiguous for a in wide.arrays().values())


def test_take_and_concatenate(gaussians):
    parts = [gaussians.take([0, 3]), gaussians.take(np.array([False, True, True, False, True]))]
    again = Gaussians.concatenate(parts)
    for name, array in gaussians.arrays().items():
        np.testing.assert_array_equal(again.arrays()[name], array[[0, 3, 1, 2, 4]])
