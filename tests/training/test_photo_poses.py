"""Poses: motions against the matrix exponential, gradients against central differences, alignment with a scene."""

import numpy as np
import pytest
from scipy.linalg import expm

from clsplat.config import OptimConfig
from clsplat.metrics import to_uint8
from clsplat.render import render
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.testing import synthetic_scene
from clsplat.training import photo_poses as poses
from clsplat.training.photo_parameters import PerPhoto


def generator(twist):
    w, t = twist[:3], twist[3:]
    matrix = np.zeros((4, 4))
    matrix[:3, :3] = [[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]]
    matrix[:3, 3] = t
    return matrix


@pytest.mark.parametrize("angle", [0, 1e-9, 9.9e-4, 1.01e-3, 0.3, 3.0])
def test_motions_are_exponentials(angle):
    rng = np.random.default_rng(0)
    twist = rng.normal(size=6)
    twist[:3] *= angle / np.linalg.norm(twist[:3])
    np.testing.assert_allclose(poses.exponential(twist), expm(generator(twist)), rtol=1e-12, atol=1e-12)


def test_gradient_of_the_twist(device64):
    """The camera moves in its own frame: exp(twist) viewmat."""
    gaussians, camera = synthetic_scene(30, seed=3, margin=1e-3)
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))

    def value(twist):
        moved = poses.refined(camera, poses.exponential(twist))
        return float((render(gaussians, moved, device=device64).rgb * weights).sum())

    v_viewmat = render(gaussians, camera, device=device64).backward(weights, viewmat_grad=True).viewmat
    found = poses.twist_gradient(camera.viewmat, v_viewmat)
    step = 1e-6
    expected = [(value(step * unit) - value(-step * unit)) / (2 * step) for unit in np.eye(6)]
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_a_camera_is_aligned_with_the_scene(device):
    gaussians, camera = synthetic_scene(300, seed=0, width=64, height=48)
    scene = gaussians.astype(np.float32)
    photo = to_uint8(render(scene, camera, device=device).rgb)
    twist = np.array([0.01, -0.008, 0.006, 0.02, -0.03, 0.01])
    off = View("a.png", poses.refined(camera, poses.exponential(twist)), photo)
    found = poses.aligned(scene, off, 2.0, OptimConfig(), Renderer(device))
    before, after = (np.abs(c.viewmat - camera.viewmat).max() for c in (off.camera, found.camera))
    assert before > 0.02
    assert after < 0.05 * before
    assert (found.name, found.image is photo) == ("a.png", True)


def test_only_the_photo_in_question_moves():
    learned = poses.start(["a", "b"])
    camera = synthetic_scene(1)[1]
    v_viewmat = np.random.default_rng(0).normal(size=(4, 4))
    poses.update(learned, "b", camera, v_viewmat, 1e-3, 5.0, OptimConfig())
    np.testing.assert_array_equal(learned.of("a"), np.eye(4))
    # Adam's first step is its rate, along each coordinate: radians, and extents of the scene.
    moved = learned.of("b")
    np.testing.assert_allclose(np.abs(moved[:3, 3]), 5e-3, rtol=1e-2)
    np.testing.assert_allclose(np.abs(moved[[2, 0, 1], [1, 2, 0]]), 1e-3, rtol=1e-2)
    # Also where other photos have taken some before.
    poses.update(learned, "a", camera, v_viewmat, 1e-3, 5.0, OptimConfig())
    np.testing.assert_array_equal(learned.of("a"), moved)


@pytest.mark.parametrize(
    "damage",
    [
        {"steps": np.array([1, -1])},
        {"steps": np.array([1.0, 1.0])},
        {"values": np.full((2, 4, 4), np.nan)},
        {"first": np.zeros((2, 7))},
    ],
)
def test_parameters_are_restored_unless_they_are_damaged(damage):
    learned = poses.start(["a", "b"])
    learned.steps[:] = 1, 2
    found = PerPhoto.restored(learned.arrays(), poses.start)
    assert found.names == ["a", "b"] and found.steps.tolist() == [1, 2]
    with pytest.raises(ValueError, match=r"of type|not finite, or negative steps"):
        PerPhoto.restored(learned.arrays() | damage, poses.start)
