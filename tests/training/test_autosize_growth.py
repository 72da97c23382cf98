"""Growth of the number of Gaussians: what is compared with what."""

from dataclasses import replace

import numpy as np
import pytest
from test_autosize import CONFIG, known_scene

from clsplat.config import CoarseConfig
from clsplat.device import Device
from clsplat.training.autosize.rule import Search, SmallSide, candidate
from clsplat.training.autosize.search import _compared
from clsplat.training.session import Training
from clsplat.training.state import initial_state


@pytest.mark.parametrize(("gain", "paid"), [(1.0, 1800), (0.0, 500)])
def test_what_has_paid_is_what_later_growth_is_compared_with(device: Device, gain: float, paid: int) -> None:
    scene = known_scene(20, device, copies=90, views=10)
    training = Training(scene, CONFIG, device, initial_state(scene, CONFIG))
    assert len(training.state.gaussians) == 1800
    side = SmallSide(None, candidate(1, 500, 3, [[30.0, 30.0]], CONFIG))  # type: ignore[arg-type]
    search = _compared(training, Search(1800, small_side=side, validated=[[30 + gain] * 2]), 900)
    assert search.small_side and search.small_side.candidate.n == paid
    assert [trial.takes_smaller for trial in search.trials] == [paid == 500]


@pytest.mark.parametrize(("paid", "compared"), [(600, False), (900, True)])
def test_sizes_trained_on_photos_of_other_sizes_are_not_compared(device: Device, paid: int, compared: bool) -> None:
    """Larger photos since the last size would decide, not more Gaussians; the present one is taken."""
    scene = known_scene(20, device, copies=90, views=10)
    config = replace(CONFIG, iterations=3000, coarse=CoarseConfig(factor=2, until=0.2))
    training = Training(scene, config, device, initial_state(scene, config))
    side = SmallSide(None, candidate(paid, 500, 3, [[30.0, 30.0]], config))  # type: ignore[arg-type]
    search = _compared(training, Search(1800, small_side=side, validated=[[20.0, 20.0]]), 1200)
    assert len(search.trials) == compared
    assert search.small_side and search.small_side.candidate.n == (500 if compared else 1800)


def test_where_something_moves_sizes_are_not_compared(device: Device) -> None:
    """Other pixels counted when the last size was validated; the present one is taken."""
    scene = known_scene(20, device, copies=90, views=10)
    training = Training(scene, CONFIG, device, initial_state(scene, CONFIG))
    side = SmallSide(None, candidate(600, 500, 3, [[30.0, 30.0]], CONFIG))  # type: ignore[arg-type]
    search = Search(1800, small_side=side, validated=[[20.0, 20.0]])
    assert len(_compared(training, search, 900).trials) == 1
    training.state.moving = {scene.train[0].name: np.ones((10, 12), bool)}
    found = _compared(training, search, 900)
    assert not found.trials and found.small_side and found.small_side.candidate.n == 1800
