"""Growth of the number of Gaussians: what is compared with what."""

from dataclasses import replace

import numpy as np
import pytest
from test_autosize import CONFIG, GROWING, known_scene

from clsplat.config import CoarseConfig
from clsplat.device import Device
from clsplat.training.autosize.rule import Search, SmallSide, candidate
from clsplat.training.autosize.search import _compared, _validate
from clsplat.training.autosize.validation import split
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


def test_what_moves_counts_in_neither_size(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """The smaller one was validated before it was left out, and both are validated again, on the same pixels."""
    scene = known_scene(8, device, copies=2, views=10)
    training = Training(scene, GROWING, device, initial_state(scene, GROWING))
    name = split(scene.train)[1][0].name
    training.state.moving = {name: np.arange(12)[None].repeat(10, axis=0) < 6}
    few = training.state.rows.take(np.arange(8))
    side = SmallSide(few, candidate(600, 8, 1, [[99.0, 99.0]], GROWING))
    last = [float(k) for k in _validate(training)]
    found = _compared(training, Search(16, small_side=side, validated=[[0.0, 0.0], last]), 900)
    trial = found.growth
    assert trial and trial.larger.views == last and 0 < max(trial.smaller.views) < 99
    training.state.rows = few
    assert trial.smaller.views == pytest.approx(_validate(training), abs=1e-9)
    assert trial.smaller.n == 8 and trial.smaller.iteration == 600
    training.state.moving = {}
    assert trial.smaller.views[0] != _validate(training)[0] and trial.smaller.views[1] == _validate(training)[1]
