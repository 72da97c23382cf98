"""The recipe of docs/howto/torch.md, where torch is installed; the package never imports it."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.device import Device
from clsplat.testing import synthetic_scene

PAGE = Path(__file__).parents[1] / "docs" / "howto" / "torch.md"


@pytest.fixture
def recipe() -> dict[str, Any]:
    """The names that the examples of the page define."""
    pytest.importorskip("torch", reason="torch is missing: pip install torch", exc_type=ImportError)
    names: dict[str, Any] = {}
    for example in re.findall(r"^```python\n(.*?)^```", PAGE.read_text(), flags=re.M | re.S):
        exec(compile(example, str(PAGE), "exec"), names)
    return names


def tensors(channels: int) -> list[Any]:
    import torch

    gaussians, camera = synthetic_scene(5, seed=3)
    g = gaussians.astype(np.float64)
    features = np.random.default_rng(0).normal(size=(5, channels))
    arrays = [g.means, g.quats, g.scales, g.opacities, features, camera.viewmat[None], camera.K[None]]
    return [torch.tensor(array, requires_grad=k < 5) for k, array in enumerate(arrays)]


@pytest.mark.foreign
@pytest.mark.parametrize("channels", [3, 8])
def test_the_recipe_passes_gradcheck(recipe: dict[str, Any], device64: Device, channels: int) -> None:
    import torch

    assert torch.autograd.gradcheck(
        lambda *inputs: recipe["rasterize"](*inputs, 8, 6, device=device64),
        tensors(channels),
        eps=1e-6,
        atol=1e-5,
        rtol=1e-4,
        nondet_tol=1e-9,
    )


@pytest.mark.foreign
def test_an_optimiser_of_torch_fits_photos(recipe: dict[str, Any], device: Device) -> None:
    import torch

    means, quats, scales, opacities, features, viewmats, Ks = (x.detach().float() for x in tensors(3))
    photos = torch.full((1, 29, 37, 3), 0.25)
    parameters = {"means": means, "quats": quats, "scales": scales.log(), "opacities": opacities.logit()}
    parameters["features"] = features
    for parameter in parameters.values():
        parameter.requires_grad_()
    optimiser = torch.optim.Adam(parameters.values(), 0.05)
    losses = []
    for _ in range(20):
        optimiser.zero_grad()
        loss = recipe["loss_of"](parameters, viewmats, Ks, photos)
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    assert losses[-1] < 0.8 * losses[0]
