"""What the search for the size takes away: rows by price, trials of pruning, bands of the harmonics."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_autosize import known_scene

from clsplat.config import TrainConfig
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.testing import synthetic_scene
from clsplat.training.autosize import reduction, search
from clsplat.training.autosize.reduction import costliest_rows, without_useless_bands
from clsplat.training.autosize.rule import sh_bytes


def test_bytes_of_a_gaussian() -> None:
    """Means, scales, rotation and opacity are 11 numbers; the harmonics have 3 (d + 1)^2."""
    assert [sh_bytes(degree) for degree in range(4)] == [56, 92, 152, 236]


def test_a_trial_is_validated_up_to_its_end(monkeypatch: pytest.MonkeyPatch) -> None:
    ran: list[int] = []

    class Fork:
        state = SimpleNamespace(rows=SimpleNamespace(on=lambda device: "rows"))

        def run_until(self, last: int, after: Any) -> None:
            ran.append(last)

    rows = SimpleNamespace(take=lambda kept: kept)
    state = SimpleNamespace(
        shown=lambda renderer: None, corrected=lambda views: views, rows=rows, fork=lambda rows: None, moving={}
    )
    training: Any = SimpleNamespace(
        state=state, config=TrainConfig(), renderer=None, scene=SimpleNamespace(train=[]), fork=lambda state: Fork()
    )
    for name, result in {
        "fetch": None,
        "costliest_rows": [0],
        "_validate": [30.0],
        "_candidate": "candidate",
    }.items():
        monkeypatch.setattr(search, name, lambda *_, result=result: result)
    monkeypatch.setattr(search, "window_bounds", lambda config: [100, 200, 300])
    monkeypatch.setattr(search, "validation_times", lambda config: {100, 150, 175, 200, 250})
    search._train_pruned(training, 100, lambda training, loss: None)
    assert ran == [149, 174, 199]


def test_removal_stops_at_the_number_that_is_left(monkeypatch: pytest.MonkeyPatch, device: Device) -> None:
    """A further round would price the rows that stay in another order."""
    scene = known_scene(5, device, copies=1, views=8)
    gaussians = synthetic_scene(20, 4)[0].astype(np.float32)
    enough: list[bool] = []

    def order(gaussians: Gaussians, views: Any, done: Any, renderer: Any) -> Any:
        enough.extend(done(gaussians.take(np.arange(n))) for n in (9, 10, 11))
        return np.arange(20)

    monkeypatch.setattr(reduction, "removal_order", order)
    assert len(costliest_rows(gaussians, 0.5, scene.train, Renderer(device))) == 10
    assert enough == [True, True, False]


def test_bands_that_make_renders_worse_go(device: Device) -> None:
    """All of them: the photos do not depend on the direction, and every coefficient is off."""
    scene = known_scene(12, device, copies=1, views=10)
    gaussians = synthetic_scene(12, seed=4)[0].astype(np.float32)
    rng = np.random.default_rng(0)
    gaussians.means[:] = scene.points
    gaussians.log_scales[:], gaussians.logit_opacities[:] = np.log(0.1), 2
    gaussians.sh[:] = rng.normal(0, 0.4, gaussians.sh.shape)
    fewer = without_useless_bands(gaussians, scene.train, Renderer(device))
    gone = (fewer.sh[:, 1:] == 0).all(axis=2)
    assert gone.mean() > 0.5
    np.testing.assert_array_equal(fewer.sh[:, 0], gaussians.sh[:, 0])
