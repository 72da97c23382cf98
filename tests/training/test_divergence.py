"""Divergence: what stops being finite ends the training, is named, and never replaces a finite checkpoint."""

from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from small_run import CONFIG

from clsplat import reference
from clsplat.device import Device
from clsplat.errors import ClsplatError
from clsplat.scene import Scene
from clsplat.training.checkpoint import load_state
from clsplat.training.divergence import check_loss, check_state
from clsplat.training.loop import train
from clsplat.training.state import initial_state

FIELDS = ("means", "log_scales", "quats", "logit_opacities", "sh")


@pytest.mark.parametrize("optimizer", ["device", "numpy"])
@pytest.mark.parametrize(("poisoned", "noticed"), [(6, 8), (8, 9)])
def test_a_parameter_that_is_not_finite_ends_the_training(
    scene: Scene,
    device: Device,
    tmp_path: Path,
    optimizer: Literal["device", "numpy"],
    poisoned: int,
    noticed: int,
) -> None:
    """At the next checkpoint, or at the end. The loss stays finite: such a Gaussian is left out of the image."""
    config = replace(CONFIG, iterations=9, checkpoint_every=4, optimizer=optimizer)
    losses: list[float] = []

    def poison(record: dict[str, Any]) -> None:
        losses.append(record["loss"])
        if record["iteration"] == poisoned:
            record["gaussians"].means[0] = np.nan

    message = f"training diverged: means after iteration {noticed}: 3 of 120 values are not finite; .* is intact"
    with pytest.raises(ClsplatError, match=message):
        train(scene, config, tmp_path, device, progress=poison)
    assert len(losses) == noticed - 1 and np.isfinite(losses).all()
    saved = load_state(tmp_path / "checkpoint.npz", scene.extent, config)
    assert saved.iteration == (noticed - 1) // 4 * 4
    check_state(saved, reference, tmp_path)


def test_an_interruption_saves_nothing_that_is_not_finite(scene: Scene, device: Device, tmp_path: Path) -> None:
    def poison(record: dict[str, Any]) -> None:
        if record["iteration"] == 6:
            record["gaussians"].sh[3] = np.inf
            raise KeyboardInterrupt

    config = replace(CONFIG, iterations=9, checkpoint_every=4)
    with pytest.raises(ClsplatError, match="sh after iteration 6: 12 of 480 values are not finite"):
        train(scene, config, tmp_path, device, progress=poison)
    assert load_state(tmp_path / "checkpoint.npz", scene.extent, config).iteration == 4


def test_every_array_is_checked(scene: Scene, tmp_path: Path) -> None:
    def fresh() -> Any:
        return initial_state(scene, replace(CONFIG, exposure=True, poses=True))

    check_state(fresh(), reference, tmp_path)
    parts = {name: lambda state, name=name: getattr(state.gaussians, name) for name in FIELDS}
    for which in ("first", "second"):
        parts |= {
            f"Adam's {which} moments of {name}": lambda state, w=which, n=name: getattr(getattr(state.moments, w), n)
            for name in FIELDS
        }
    parts |= {"the photos' exposures": lambda state: state.exposures.values}
    parts |= {"the photos' poses": lambda state: state.poses.values}
    for name, part in parts.items():
        state = fresh()
        part(state).flat[-1] = np.nan
        with pytest.raises(ClsplatError, match=f"diverged: {name} after iteration 0: 1 of {part(state).size} values"):
            check_state(state, reference, tmp_path)


def test_a_loss_that_is_not_finite_ends_the_training(tmp_path: Path) -> None:
    check_loss(0.1, 7, tmp_path)
    with pytest.raises(ClsplatError, match=r"diverged: the loss of iteration 7 is nan; lower .* if there is one"):
        check_loss(float("nan"), 7, tmp_path)
