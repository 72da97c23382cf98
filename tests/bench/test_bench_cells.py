"""What `clsplat bench quality` trains: scenes with options, methods, budgets, and their order."""

from pathlib import Path

import numpy as np
import pytest
from small_cells import SMALL

from clsplat.bench import measures
from clsplat.bench.captures import Capture
from clsplat.bench.cells import differences, make_cells, parse_budget, parse_method, parse_source
from clsplat.bench.measures import sample_iterations
from clsplat.config import AdcConfig, DataConfig, InitConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.training.presets import load_preset, with_settings


class TestCells:
    def test_a_dataset_may_have_options_for_its_photos(self):
        source = parse_source("some/where/lego:background=white:test_every=4")
        assert (source.name, source.path) == ("lego:background=white:test_every=4", Path("some/where/lego"))
        assert source.data == DataConfig(background="white", test_every=4)
        assert parse_source("C:/photos").path == Path("C:/photos")
        assert parse_source("C:/photos:downscale=2").data == DataConfig(downscale=2)
        variant = parse_source("lego:thin=4:downscale=2:points=0.5")
        assert (variant.data, variant.capture) == (DataConfig(downscale=2), Capture(thin=4, points=0.5))
        assert source.capture == Capture()

    @pytest.mark.parametrize(
        ("text", "expected"),
        [
            ("a:downscal=2", "downscal: expected one of background"),
            ("a:downscale=17", "downscale: expected an integer or 'auto', 1 to 16"),
            ("a:thinn=3", "variants: thin, arc, points.*thinn: expected one of"),
            ("a:thin=0.5", "thin: expected"),
            ("a:thin=0", "thin: expected an integer, 1 or more, found 0"),
            ("a:arc=1", "arc: expected a finite number, 0 or more and below 1, found 1"),
            ("a:points=0", "points: expected a finite number, above 0 and at most 1, found 0"),
        ],
    )
    def test_invalid_options_are_refused(self, text, expected):
        with pytest.raises(InputError, match=expected):
            parse_source(text)

    def test_methods_are_presets_or_files(self, data):
        assert parse_method("mcmc") == ("mcmc", load_preset("mcmc"))
        assert parse_method(str(data / "plain.json")) == ("plain", with_settings(TrainConfig(), SMALL, ""))
        with pytest.raises(InputError, match="expected one of"):
            parse_method("slow")

    @pytest.mark.parametrize(
        ("text", "own", "cap"),
        [("own", 7, 7), ("own", None, None), ("x0.5", 9, 4), ("x2", 9, 18), ("x.5", None, None), ("300", 7, 300)],
    )
    def test_budgets(self, text, own, cap):
        assert parse_budget(text, own) == cap

    @pytest.mark.parametrize("text", ["", "x", "x0", "-3", "0", "0.5", "x-1", "1e5", "owner"])
    def test_invalid_budgets_are_refused(self, text):
        with pytest.raises(InputError, match="--budgets: expected own"):
            parse_budget(text, 5)

    def test_every_combination_once(self):
        cells = make_cells(["a:downscale=2", "b"], ["paper-7k", "mcmc"], ["own", "x0.5", "1000"], [10, 20])
        cap = load_preset("mcmc").max_gaussians
        assert cap is not None
        found = {(c.source.name, c.method, c.config.max_gaussians, c.config.iterations) for c in cells}
        # Half of no cap is no cap, so this training runs once.
        caps = {"paper-7k": (None, 1000), "mcmc": (cap, cap // 2, 1000)}
        expected = {(s, m, n, i) for s in ("a:downscale=2", "b") for m in caps for n in caps[m] for i in (10, 20)}
        assert found == expected
        assert len(cells) == len(expected)
        assert [c.source.name for c in cells] == sorted(c.source.name for c in cells), "photos are read once"
        assert all(c.config.data.downscale == (2 if c.source.name != "b" else "auto") for c in cells)

    def test_all_trainings_of_a_seed_come_first(self):
        cells = make_cells(["a", "b"], ["mcmc", "paper-7k"], ["own"], [], seeds=[5, 3])
        assert [(c.config.seed, c.source.name, c.method) for c in cells] == [
            (seed, scene, method) for seed in (5, 3) for scene in "ab" for method in ("mcmc", "paper-7k")
        ]

    def test_a_methods_own_iterations(self):
        (cell,) = make_cells(["a"], ["paper-30k"], ["own"], [])
        assert cell.config.iterations == 30_000

    def test_equal_names_are_refused(self, tmp_path):
        for folder in ("a", "b"):
            (tmp_path / folder).mkdir()
            (tmp_path / folder / "m.json").write_text("{}")
        with pytest.raises(InputError, match="data: expected different names, found scene 2 times"):
            make_cells(["a/scene", "b/scene"], ["mcmc"], ["own"], [])
        with pytest.raises(InputError, match="--methods: expected different names, found m 2 times"):
            make_cells(["a"], [str(tmp_path / "a" / "m.json"), str(tmp_path / "b" / "m.json")], ["own"], [])

    def test_nothing_to_train_is_refused(self):
        for sources, methods, budgets in (([], ["mcmc"], ["own"]), (["a"], [], ["own"]), (["a"], ["mcmc"], [])):
            with pytest.raises(InputError, match="expected at least one of each"):
                make_cells(sources, methods, budgets, [])

    def test_settings_are_those_that_differ_from_the_defaults(self):
        config = TrainConfig(seed=3, adc=AdcConfig(every=7), init=InitConfig(opacity=0.5))
        assert differences(config) == {"seed": 3, "adc": {"every": 7}, "init": {"opacity": 0.5}}
        assert with_settings(TrainConfig(), differences(config), "") == config

    def test_samples_form_a_geometric_sequence(self):
        assert sample_iterations(7000)[0] == 140
        assert sample_iterations(7000)[-1] == 7000
        assert len(sample_iterations(7000)) == measures.SAMPLES
        assert np.ptp(np.diff(np.log(sample_iterations(7000)))) < 0.01
        assert sample_iterations(1) == [1]
