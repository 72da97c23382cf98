"""Against an independent renderer: gsplat's PyTorch reference in float64; inputs and outputs lie in ../shared/gold.

Its README states the conventions, which are ours, and how close is close.
"""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.config import RenderConfig
from clsplat.gaussians import Gaussians, logit
from clsplat.render import render

pytestmark = pytest.mark.shared

CASES = pytest.mark.parametrize(
    ("name", "mode"), [("synth_1k", "classic"), ("synth_1k", "antialiased"), ("synth_10k", "classic")]
)


@pytest.fixture(scope="module")
def gold(shared):
    """Input and expected output by name, read once; squeezed: the files have a batch of one view."""
    files = {}

    def load(name):
        if name not in files:
            with np.load(shared / "gold" / f"{name}.npz") as data:
                files[name] = {key: data[key].squeeze() for key in data.files}
        return files[name]

    return load


def scene_of(inputs):
    # float64 before the logarithms: opacities close to 1 lose seven digits of their logit in float32.
    means, scales, quats, opacities, sh = (
        inputs[k].astype(np.float64) for k in ("means", "scales", "quats", "opacities", "sh")
    )
    K = inputs["Ks"]
    size = int(inputs["width"]), int(inputs["height"])
    camera = Camera(inputs["viewmats"], K[0, 0], K[1, 1], K[0, 2], K[1, 2], *size)
    return Gaussians(means, np.log(scales), quats, logit(opacities), sh), camera


def compare(gold, name, mode, device, compositor, image_atol, gradient_rtol):
    inputs, expected = gold(name), gold(f"gold_{name}_{mode}_f64")
    gaussians, camera = scene_of(inputs)
    config = RenderConfig(mode, compositor=compositor)
    rendering = render(gaussians, camera, config, device, background=tuple(inputs["background"]))
    clear = expected["ambiguous"] == 0
    assert clear.mean() > 0.98
    for actual, key in ((rendering.rgb, "render"), (rendering.alpha, "alpha")):
        error = np.abs(actual - expected[key])
        assert error[clear].max() <= image_atol, key
        # Elsewhere one pair may flip, or T stop a pair early or late.
        assert error.max() <= image_atol + 1 / 255, key

    v = rendering.backward(inputs["v_render"], inputs["v_alpha"], viewmat_grad=True)
    # The gold gradients are those of the activated parameters.
    opacities = inputs["opacities"].astype(np.float64)
    gradients = {
        "means2d": v.means2d,
        "means": v.gaussians.means,
        "quats": v.gaussians.quats,
        "scales": v.gaussians.log_scales / inputs["scales"].astype(np.float64),
        "opacities": v.gaussians.logit_opacities / (opacities * (1 - opacities)),
        "sh": v.gaussians.sh,
        # The last row of a viewmat is constant for us, an input like any other for autograd.
        "viewmats": v.viewmat[:3],
    }
    for key, actual in gradients.items():
        wanted = expected[f"v_{key}"][:3] if key == "viewmats" else expected[f"v_{key}"]
        error = np.linalg.norm(actual - wanted) / np.linalg.norm(wanted)
        assert error <= gradient_rtol, f"v_{key}: relative L2 error {error:.2g}"


@CASES
@pytest.mark.parametrize("compositor", ["cpu", "gpu"])
def test_float(gold, device, name, mode, compositor):
    compare(gold, name, mode, device, compositor, image_atol=2e-4, gradient_rtol=1e-3)


@CASES
@pytest.mark.parametrize("compositor", ["cpu", "gpu"])
def test_double(gold, device64, name, mode, compositor):
    compare(gold, name, mode, device64, compositor, image_atol=1e-9, gradient_rtol=1e-9)


@CASES
def test_twin(gold, name, mode):
    compare(gold, name, mode, "reference", "auto", image_atol=1e-9, gradient_rtol=1e-9)
