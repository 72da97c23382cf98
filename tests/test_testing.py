"""The checks themselves: each must fail where it should."""

import numpy as np
import pytest

from clsplat import reference
from clsplat.constants import ALPHA_MIN
from clsplat.errors import InputError
from clsplat.gaussians import logit
from clsplat.testing import (
    Tolerance,
    ambiguous_pixels,
    assert_matches,
    gradcheck,
    synthetic_scene,
    threshold_distances,
)

TABLE = {"x": Tolerance(0.01, 0.001, "an example")}


class TestAssertMatches:
    expected = np.array([[1.0, 10.0], [0.0, 0.5]])  # admits 0.02, 0.11, 0.01 and 0.015

    def test_within(self):
        assert_matches("x", self.expected + np.array([[0.019, -0.109], [0.009, 0.014]]), self.expected, TABLE)
        assert_matches("x", np.zeros((0, 3)), np.zeros((0, 3)), TABLE)

    @pytest.mark.parametrize(("place", "error"), [((0, 0), 0.021), ((0, 1), -0.111), ((1, 0), 0.011)])
    def test_beyond(self, place, error):
        actual = self.expected.copy()
        actual[place] += error
        with pytest.raises(AssertionError, match=rf"x\[{place[0]}, {place[1]}\]: .* 1 of 4 differ .* \(an example\)"):
            assert_matches("x", actual, self.expected, TABLE)
        where = np.ones((2, 2), dtype=bool)
        where[place] = False
        assert_matches("x", actual, self.expected, TABLE, where=where)

    def test_shape(self):
        with pytest.raises(AssertionError, match=r"x: expected shape \(2, 2\), found \(4,\)"):
            assert_matches("x", self.expected.ravel(), self.expected, TABLE)

    def test_not_finite(self):
        with pytest.raises(AssertionError, match="x: 4 values are not finite"):
            assert_matches("x", np.full((2, 2), np.nan), self.expected, TABLE)
        with pytest.raises(AssertionError, match="expected values are not finite"):
            assert_matches("x", self.expected, np.full((2, 2), np.inf), TABLE)


class TestGradcheck:
    @property
    def inputs(self):
        return {"a": np.linspace(0.5, 2, 6).reshape(2, 3), "b": np.linspace(-1, 1, 4)}

    @staticmethod
    def function(a, b):
        return float(np.sin(a).sum() * np.exp(b).sum())

    def gradients(self):
        a, b = self.inputs["a"], self.inputs["b"]
        return {"a": np.cos(a) * np.exp(b).sum(), "b": np.sin(a).sum() * np.exp(b)}

    def test_right(self):
        gradcheck(self.function, self.inputs, self.gradients())

    @pytest.mark.parametrize("name", ["a", "b"])
    def test_wrong_in_one_entry(self, name):
        gradients = self.gradients()
        gradients[name].flat[2] *= 1 + 1e-4
        with pytest.raises(AssertionError, match=f"v_{name}, .*: central difference"):
            gradcheck(self.function, self.inputs, gradients)

    def test_wrong_by_a_factor(self):
        with pytest.raises(AssertionError, match=r"v_a, direction \d"):
            gradcheck(self.function, self.inputs, {"a": 1.00001 * self.gradients()["a"]})

    def test_wrong_shape_or_nan(self):
        with pytest.raises(AssertionError, match="v_a: expected shape"):
            gradcheck(self.function, self.inputs, {"a": self.gradients()["a"].T})
        with pytest.raises(AssertionError, match="v_b: 4 values are not finite"):
            gradcheck(self.function, self.inputs, {"b": np.full(4, np.nan)})

    def test_zero_gradient(self):
        gradcheck(lambda a: 1.0, {"a": np.ones(3)}, {"a": np.zeros(3)})
        with pytest.raises(AssertionError):
            gradcheck(lambda a: float(a.sum()), {"a": np.ones(3)}, {"a": np.zeros(3)})


class TestScenes:
    def test_seed(self):
        first, again, other = (synthetic_scene(20, seed)[0] for seed in (1, 1, 2))
        np.testing.assert_array_equal(first.means, again.means)
        assert not (first.means == other.means).any()

    def test_most_are_seen(self):
        gaussians, camera = synthetic_scene(200)
        assert (reference.project_fwd(gaussians, camera, 3).extents[:, 0] > 0).mean() > 0.9

    def test_margin_is_kept(self):
        kept, camera = synthetic_scene(30, 3, margin=2e-3)
        assert threshold_distances(kept, camera).min() >= 2e-3
        assert threshold_distances(kept, camera, antialiased=True).min() >= 2e-3
        assert threshold_distances(*synthetic_scene(30, 3)).min() < 2e-3

    def test_margin_that_cannot_be_kept(self):
        with pytest.raises(InputError, match="margin: expected one that 50 random Gaussians can keep at 37x29 px"):
            synthetic_scene(50, margin=0.5)

    # Each threshold, approached by one Gaussian in the middle of the image.
    @pytest.mark.parametrize(
        "case", ["near", "alpha min", "alpha max", "opacity", "colour", "slope", "floor", "order"]
    )
    def test_distance_from_each_threshold(self, case):
        gaussians, camera = synthetic_scene(2, 0, sh_degree=0)
        place = {"near": [0, 0, 0.01 * np.exp(-1e-4)], "slope": [3, 0, 3], "order": [0, 0, 3]}.get(case, [0, 0, 3])
        if case == "slope":
            place[0] = 3 * ((camera.width - camera.cx + 0.15 * camera.width) / camera.fx + 1e-4)
        points = np.array([place, [0, 0, 3 * np.exp(1e-4) if case == "order" else 5]], dtype=np.float64)
        gaussians.means[:] = (points - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
        gaussians.log_scales[:] = np.log(0.3)
        gaussians.logit_opacities[:] = 0
        gaussians.sh[:] = 1
        if case == "alpha min":
            # Where no pixel's centre happens to lie at the border, the opacity puts one there.
            splats = reference.project_fwd(gaussians, camera, 0)
            a, _, c = splats.conics[0]
            sigma = 0.5 * a * 9 + 0.5 * c * 4 + splats.conics[0, 1] * 6
            gaussians.logit_opacities[0] = logit(ALPHA_MIN * np.exp(sigma + 1e-4))
        elif case == "alpha max":
            gaussians.logit_opacities[0] = logit(0.99 * np.exp(1e-4))
        elif case == "opacity":
            gaussians.logit_opacities[0] = logit(ALPHA_MIN * np.exp(1e-4))
        elif case == "colour":
            gaussians.sh[0, 0, 1] = -(0.5 + 1e-4) / 0.28209479177387814
        elif case == "floor":
            gaussians.log_scales[0] = -12
            gaussians.logit_opacities[0] = 4
        distance = threshold_distances(gaussians, camera, antialiased=case == "floor")[0]
        assert distance == pytest.approx(0 if case == "floor" else 1e-4, rel=0.02, abs=1e-9)

    def test_ambiguous_pixels_are_those_that_flip(self):
        """Opacities a little smaller and larger: the pixels that jump are a subset, and some do."""
        gaussians, camera = synthetic_scene(100, 4, width=97, height=71)
        gaussians.logit_opacities[:] = -2  # faint, lest the change itself be as large as a jump
        splats = reference.project_fwd(gaussians, camera, 3)
        images = []
        for factor in (1 - 1e-4, 1 + 1e-4):
            changed = splats._replace(opacities=splats.opacities * factor)
            bins = reference.bin_splats(changed, camera.width, camera.height, 97)
            images.append(reference.composite_fwd(changed, bins, np.zeros(3)).alpha)
        jumps = np.abs(images[1] - images[0]) > 0.5 * ALPHA_MIN * (1 - images[0])
        ambiguous = ambiguous_pixels(splats, camera.width, camera.height, margin=1.1e-4)
        assert jumps.any() and not (jumps & ~ambiguous).any()
        assert ambiguous.mean() < 0.05
