"""Configurations as files: presets, config.json of a run; what is wrong in them is named."""

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from clsplat.config import AdcConfig, DataConfig, FewViewsConfig, InitConfig, OptimConfig, SfmConfig, TrainConfig
from clsplat.errors import InputError
from clsplat.training.densify import STRATEGIES
from clsplat.training.presets import FOLDER, PRESETS, load_config, load_preset, read_settings, with_settings


def leaves(settings, within=()):
    for name, value in settings.items():
        if isinstance(value, dict):
            yield from leaves(value, (*within, name))
        else:
            yield (*within, name), value


def test_the_presets_are_those_that_are_promised():
    assert {"paper-7k", "paper-30k", "mcmc"} == set(PRESETS)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_sets_what_it_holds_and_nothing_else(name):
    config = load_preset(name)
    STRATEGIES[config.strategy](config, 1.0, 100)  # raises an error if the strategy needs a cap and there is none
    held = dict(leaves(read_settings(FOLDER / f"{name}.json")))
    for path, value in leaves(asdict(config)):
        default = asdict(TrainConfig())
        for key in path:
            default = default[key]
        assert value == held.get(path, default), path


def test_the_papers_presets_are_its_strategy_and_iterations():
    rates = OptimConfig(
        means_lr=1.6e-4,
        means_lr_final=1.6e-6,
        log_scales_lr=5e-3,
        quats_lr=1e-3,
        logit_opacities_lr=5e-2,
        sh0_lr=2.5e-3,
        sh_rest_lr=2.5e-3 / 20,
        rates_final=1.0,
        beta2=0.999,
        sh_degree_every=1000,
    )
    start, few = InitConfig(triangulate=False, dense=False, sky=False), FewViewsConfig(below=0)
    added = {"even_brightness": False, "mask_moving": False}
    paper = TrainConfig(strategy="adc", size="fixed", init=start, few=few, optim=rates, **added)
    assert load_preset("paper-7k") == replace(paper, iterations=7000)
    assert load_preset("paper-30k") == replace(paper, iterations=30_000)


def test_the_size_is_searched_by_default():
    assert TrainConfig().size == "auto" and TrainConfig().strategy == "error"


def test_what_was_saved_is_read_back(tmp_path):
    config = TrainConfig(
        iterations=12,
        max_gaussians=None,
        memory_limit="4GB",
        data=DataConfig(downscale=4, masks="m", sfm=SfmConfig(single_camera=False)),
        optim=OptimConfig(means_lr=1 / 3),
        adc=AdcConfig(stop_fraction=0.1),
    )
    path = tmp_path / "config.json"
    path.write_text(json.dumps({"data_path": "somewhere", **asdict(config)}))
    assert load_config(path) == config


def test_what_is_left_out_stays_and_integers_are_numbers():
    base = TrainConfig(iterations=5, adc=AdcConfig(every=3))
    changed = with_settings(base, {"adc": {"scale_max": 1}, "max_gaussians": 7}, "here")
    assert changed == replace(base, adc=AdcConfig(every=3, scale_max=1.0), max_gaussians=7)
    assert type(changed.adc.scale_max) is float


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"iteration": 5}, "iteration: expected one of adc, blocks, checkpoint_every, "),
        ({"data": {"sfm": {"match": 1}}}, "data.sfm.match: expected one of camera_model, mapper, matching, "),
        ({"iterations": 5.0}, "iterations: expected an integer, 0 to 4294967295, found 5.0"),
        ({"iterations": True}, "iterations: expected an integer, 0 to 4294967295, found True"),
        ({"iterations": "5"}, "iterations: expected an integer, 0 to 4294967295, found '5'"),
        ({"iterations": None}, "iterations: expected an integer, 0 to 4294967295, found None"),
        ({"max_gaussians": 1.5}, "max_gaussians: expected an integer, 1 to 4294967295, found 1.5"),
        ({"optim": {"eps": float("nan")}}, "optim.eps: expected a finite number, above 0, found nan"),
        ({"optim": {"eps": float("-inf")}}, "optim.eps: expected a finite number, above 0, found -inf"),
        ({"optim": {"eps": 10**400}}, "optim.eps: expected a finite number, above 0, found 1000"),
        ({"optim": {"eps": False}}, "optim.eps: expected a finite number, above 0, found False"),
        ({"optim": 3}, "optim: expected an object of settings, found 3"),
        ({"strategy": 3}, "strategy: expected one of adc, mcmc, error, found 3"),
        ({"size": "Auto"}, "size: expected 'auto', 'fixed', found 'Auto'"),
        ({"data": {"downscale": 17}}, "data.downscale: expected an integer or 'auto', 1 to 16, found 17"),
        ({"data": {"downscale": True}}, "data.downscale: expected an integer or 'auto', 1 to 16, found True"),
        ({"data": {"sfm": {"single_camera": 1}}}, "data.sfm.single_camera: expected true or false, found 1"),
        ({"init": {"opacity": "high"}}, "init.opacity: expected a finite number, above 0 and below 1, found 'high'"),
    ],
)
def test_wrong_settings_are_named(tmp_path, settings, expected):
    path = tmp_path / "mine.json"
    path.write_text(json.dumps(settings))
    with pytest.raises(InputError) as error:
        load_config(path)
    assert str(error.value).startswith(f"{path}: ")
    assert expected in str(error.value)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "expected JSON"),
        (b"{", "expected JSON"),
        (b"\xff\xfe", "expected JSON"),
        (b"[1]", "expected an object of settings"),
        (b'{"seed": 1, "seed": 2}', "seed: expected it once, found it 2 times"),
    ],
)
def test_files_that_are_no_settings(tmp_path, content, expected):
    path = tmp_path / "mine.json"
    path.write_bytes(content)
    with pytest.raises(InputError, match=expected) as error:
        load_config(path)
    assert "mine.json" in str(error.value)


def test_missing_files_and_presets(tmp_path: Path):
    with pytest.raises(InputError, match=r"cannot read .*nothing\.json: No such file"):
        load_config(tmp_path / "nothing.json")
    with pytest.raises(InputError, match=rf"--preset: expected one of {', '.join(PRESETS)}, found 'slow'"):
        load_preset("slow")


def test_yaml_says_the_same(tmp_path):
    path = tmp_path / "mine.yaml"
    path.write_text("iterations: 12  # few\nstrategy: adc\nmax_gaussians: null\noptim:\n  means_lr: 1.0e-3\n")
    expected = replace(TrainConfig(), iterations=12, strategy="adc", optim=OptimConfig(means_lr=1e-3))
    assert load_config(path) == expected


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("iterations: 12\niterations: 13\n", "iterations: expected it once, found it 2 times"),
        ("a: [1\n", "expected YAML, found: while parsing"),
        ("!!python/object/apply:os.system [ls]\n", "expected YAML, found: could not determine a constructor"),
        ("- 1\n", "expected an object of settings"),
        ("optim: {means_lr: fast}\n", "optim.means_lr: expected a finite number, above 0, found 'fast'"),
        ("", "expected an object of settings, found None"),
    ],
)
def test_yaml_that_means_nothing_is_refused(tmp_path, text, message):
    path = tmp_path / "mine.yml"
    path.write_text(text)
    with pytest.raises(InputError, match=f"^{path}: .*{message}"):
        load_config(path)
