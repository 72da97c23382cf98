"""Training in blocks from the command line: a run like any other, resumed, printed as jobs, and refused."""

import json
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from cli_runs import fails, run

from clsplat.blocks.block import result_of, train_block
from clsplat.blocks.jobs import read_job
from clsplat.blocks.masks import masks_of
from clsplat.blocks.settings import REFINING_LENGTHS
from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.errors import InputError
from clsplat.formats import load_gaussians
from clsplat.gaussians import Gaussians
from clsplat.renderer import Renderer
from clsplat.scene import View
from clsplat.training import session
from clsplat.training.moving import Masks

TRAIN = (
    *("--iterations", 40, "--size", "fixed", "--max-gaussians", 240, "--init.no-triangulate", "--few.below", 3),
    *("--init.random-points", 80, "--checkpoint-every", 20),
)


def test_a_run_is_like_any_other_and_printed_jobs_make_the_same(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "here"
    run("train", dataset, "-o", out, *TRAIN, "--blocks", 2)
    said = capsys.readouterr().err
    assert "blocks: 2, each with " in said and "held-out photos: PSNR" in said
    names = {path.name for path in out.iterdir()}
    assert names == {"blocks", "config.json", "eval", "log.jsonl", "scene.ply", "training_curve.png"}
    last = json.loads((out / "log.jsonl").read_text().splitlines()[-1])
    assert last["num_gaussians"] == len(load_gaussians(out / "scene.ply")[0]) and last["psnr"] > 10
    run("info", out)
    assert "Gaussians" in capsys.readouterr().out

    printed = tmp_path / "printed"
    arguments = ["train", dataset, "-o", printed, *TRAIN, "--blocks", 2, "--print-jobs"]
    assert len(REFINING_LENGTHS) == 2
    for resume, count in (([], 2), (["--resume"], 3), (["--resume"], 2)):
        run(*arguments, *resume)
        jobs = capsys.readouterr().out.splitlines()
        assert len(jobs) == count and not (printed / "scene.ply").exists()
        for job in jobs:
            program, *words = shlex.split(job)
            assert program == "clsplat"
            run(*words)
        capsys.readouterr()
    run(*arguments, "--resume")
    assert (printed / "scene.ply").read_bytes() == (out / "scene.ply").read_bytes()

    before = (out / "scene.ply").read_bytes()
    capsys.readouterr()
    run("train", dataset, "-o", tmp_path / "here.spz", *TRAIN, "--blocks", 2, "--resume")
    assert len(load_gaussians(tmp_path / "here.spz")[0]) == last["num_gaussians"]
    assert "block 1" not in capsys.readouterr().err and (out / "scene.ply").read_bytes() == before
    text = fails(capsys, "train", dataset, "-o", out, *TRAIN, "--blocks", 2, "--resume", "--seed", 1)
    assert "expected the configuration it was made with, --seed 0, found --seed 1" in text
    assert "holds a run already" in fails(capsys, "train", dataset, "-o", out, *TRAIN, "--blocks", 2)


def test_what_the_coarse_run_finds_moving_trains_in_no_block(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    looks = []

    def left_half(renderer: Renderer, gaussians: Gaussians, views: list[View], degree: int) -> Masks:
        looks.append(len(views))
        return {views[1].name: np.arange(8)[None].repeat(6, axis=0) < 4}

    monkeypatch.setattr(session, "due", lambda iteration, iterations, found: iteration == 5)
    monkeypatch.setattr(session, "moving", left_half)
    out, count = tmp_path / "out", len(load_scene(dataset, DataConfig()).train)
    run("train", dataset, "-o", out, *TRAIN, "--blocks", 2)
    said = capsys.readouterr().err
    assert looks == [count], "blocks do not look for themselves"
    assert f"moving: 1 of {count} training photos" in said and (out / "moving.png").exists()
    jobs = [path for path in (out / "blocks").glob("*.json") if not path.stem.startswith("coarse")]
    assert len(jobs) == 2 + 3 + 2
    for job in jobs:
        (mask,) = masks_of(job, read_job(job)).values()
        assert mask[:, :4].all() and not mask[:, 4:].any()

    path, job = next((p, j) for p in jobs if (j := read_job(p)).scene == j.far and {*masks_of(p, j)} <= {*j.photos})
    unmasked = train_block(replace(job, moving="").write(path.parent))
    assert unmasked.read_bytes() != result_of(path).read_bytes()

    run("train", dataset, "-o", tmp_path / "all", *TRAIN, "--blocks", 2, "--no-mask-moving")
    before = (out / "scene.ply").read_bytes()
    assert (tmp_path / "all" / "scene.ply").read_bytes() != before
    for path in (out / "scene.ply", out / "moving.npz", *map(result_of, jobs)):
        path.unlink()
    run("train", dataset, "-o", out, *TRAIN, "--blocks", 2, "--resume")
    assert (out / "scene.ply").read_bytes() == before and looks == [count]

    (out / "blocks" / read_job(jobs[0]).moving).write_bytes((out / "moving.npz").read_bytes() + b" ")
    with pytest.raises(InputError, match="expected masks as they were written, found a changed file"):
        masks_of(jobs[0], read_job(jobs[0]))


def test_one_block_is_todays_training(dataset: Path, tmp_path: Path) -> None:
    for name, blocks in (("plain", ()), ("one", ("--blocks", 1)), ("auto", ("--blocks", "auto"))):
        run("train", dataset, "-o", tmp_path / name, *TRAIN, *blocks)
    scenes = [(tmp_path / name / "scene.ply").read_bytes() for name in ("plain", "one", "auto")]
    assert scenes[0] == scenes[1] == scenes[2]
    assert not (tmp_path / "auto" / "blocks").exists()


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--blocks", 2, "--poses"), "--poses: expected a training without --blocks"),
        (("--blocks", 99), "--blocks: expected at most 3, as the coarse scene has 60 Gaussians, found 99"),
        (("--blocks", 0), "--blocks"),
        (("--print-jobs",), "expected with --blocks, found --blocks 1"),
    ],
)
def test_what_cannot_train_in_blocks(
    dataset: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], flags: tuple[object, ...], message: str
) -> None:
    assert message in fails(capsys, "train", dataset, "-o", tmp_path / "out", *TRAIN, *flags)
