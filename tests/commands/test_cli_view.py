"""The viewer, opened by the commands `view` and `train`."""

import shutil
import sys
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_runs import TRAIN, fails, run

from clsplat.config import DataConfig
from clsplat.dataset import load_scene
from clsplat.formats import FORMATS, load_gaussians, save_gaussians
from clsplat.gaussians import Gaussians


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Gaussians]]:
    """The Gaussians shown by viewers, with the text of their panel; Ctrl-C is simulated at once."""
    pytest.importorskip("viser", reason="viser, the extra `viewer`, is missing")
    from clsplat.show.viewer import Viewer

    seen: list[tuple[str, Gaussians]] = []

    def hold(self: Viewer, gaussians: Gaussians, until: object = None) -> None:
        seen.append((self._facts, gaussians))
        raise KeyboardInterrupt

    monkeypatch.setattr(Viewer, "hold", hold)
    return seen


@pytest.mark.parametrize("suffix", FORMATS)
def test_view_opens_every_format(
    trained: Path, tmp_path: Path, held: list[tuple[str, Gaussians]], suffix: str
) -> None:
    scene = tmp_path / f"scene{suffix}"
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about data that the format cannot hold
        run("export", trained / "scene.ply", scene)
    run("view", scene, "--port", 18090)
    ((facts, gaussians),) = held
    assert scene.name in facts
    for name, array in load_gaussians(scene)[0].arrays().items():
        np.testing.assert_array_equal(gaussians.arrays()[name], array)


def test_view_goes_to_the_photos(
    trained: Path, dataset: Path, tmp_path: Path, held: list[tuple[str, Gaussians]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from clsplat.show.viewer import Viewer

    made: list[tuple[object, ...]] = []
    show = Viewer.show

    def watched(self: Viewer, *arguments: object) -> None:
        made.append(arguments)
        show(self, *arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(Viewer, "show", watched)
    gaussians = load_gaussians(trained / "scene.ply")[0]
    save_gaussians(tmp_path / "scene.ply", gaussians, offset=(10.0, 0.0, 0.0))  # the offset of the dataset is 0
    run("view", tmp_path / "scene.ply", "--data", dataset, "--port", 18090)
    scene = load_scene(dataset, DataConfig())
    _, viewpoint, views = made[0]
    assert len(views) == 9
    np.testing.assert_array_equal(viewpoint.camera.viewmat, scene.train[0].camera.viewmat)
    np.testing.assert_allclose(held[0][1].means, gaussians.means + np.float32([10, 0, 0]), rtol=1e-6)


def test_train_with_a_viewer_ends_with_the_same_bits_and_stays_open(
    trained: Path, dataset: Path, tmp_path: Path, held: list[tuple[str, Gaussians]], monkeypatch: pytest.MonkeyPatch
) -> None:
    from clsplat.show.viewer import Viewer

    sizes: list[int] = []
    monkeypatch.setattr(Viewer, "follow", lambda self, gaussians, interrupted: sizes.append(len(gaussians)))
    run("train", dataset, "-o", tmp_path / "out", "--viewer", "--port", 18090, *TRAIN)
    ((facts, _),) = held
    assert len(sizes) == 20, "every iteration is shown"
    assert "20 of 20" in facts and f"{sizes[-1]:,}" in facts and "PSNR" in facts
    assert (tmp_path / "out" / "scene.ply").read_bytes() == (trained / "scene.ply").read_bytes()


def test_a_missing_viewer_is_a_sentence(
    trained: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'clsplat[viewer]'" in fails(capsys, "view", trained / "scene.ply")


def test_view_of_a_run_has_its_cameras_and_saves_edits_beside_its_scene(
    trained: Path, held: list[tuple[str, Gaussians]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from clsplat.show.viewer import Viewer

    seen: list[object] = []
    monkeypatch.setattr(Viewer, "edit", lambda self, gaussians, save: seen.append(save(gaussians.take(np.arange(5)))))
    monkeypatch.setattr(Viewer, "show", lambda self, renderer, start, views: seen.append(len(views)))
    monkeypatch.setattr(Viewer, "wait", lambda self, reason: seen.append(reason))
    folder = Path(shutil.copytree(trained, tmp_path / "run"))
    run("view", folder, "--port", 18090)
    path = folder / "scene_edited.ply"
    assert seen == ["reading scene.ply", "reading the photos", "compiling kernels", 9, f"{path}: 5 Gaussians"]
    assert len(load_gaussians(path)[0]) == 5
    assert (folder / "scene.ply").read_bytes() == (trained / "scene.ply").read_bytes()


def test_a_session_keeps_the_edits_of_earlier_ones(
    trained: Path, held: list[tuple[str, Gaussians]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from clsplat.show.viewer import Viewer

    def save_twice(self: Viewer, gaussians: Gaussians, save: Callable[[Gaussians], str]) -> None:
        for count in (9, 5 + len(held)):
            save(gaussians.take(np.arange(count)))

    monkeypatch.setattr(Viewer, "edit", save_twice)
    shutil.copy(trained / "scene.ply", tmp_path)
    for _ in range(3):
        run("view", tmp_path / "scene.ply", "--port", 18090)
    files = ("scene_edited.ply", "scene_edited-2.ply", "scene_edited-3.ply")
    assert [len(load_gaussians(tmp_path / name)[0]) for name in files] == [5, 6, 7]


@pytest.mark.parametrize("found", [True, False])
def test_open_opens_a_browser_also_for_a_training(
    dataset: Path,
    tmp_path: Path,
    held: list[tuple[str, Gaussians]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    found: bool,
) -> None:
    opened: list[str] = []
    monkeypatch.setattr("webbrowser.open", lambda address: opened.append(address) or found)
    run("train", dataset, "-o", tmp_path / "out", "--open", "--port", 18090, *TRAIN)
    assert len(opened) == 1 and opened[0].startswith("http://127.0.0.1:180")
    assert ("no browser was found" in capsys.readouterr().err) == (not found)
    assert len(held) == 1


def test_what_a_training_waits_for_is_said_before_the_first_step(
    dataset: Path,
    tmp_path: Path,
    held: list[tuple[str, Gaussians]],
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from clsplat.show.viewer import Viewer

    steps: list[str] = []
    monkeypatch.setattr(Viewer, "wait", lambda self, reason: steps.append(reason.split(",")[0]))
    monkeypatch.setattr(Viewer, "show", lambda self, *_: steps.append("shown"))
    monkeypatch.setattr(Viewer, "follow", lambda self, *_: steps.append("step"))
    monkeypatch.setattr("clsplat.commands.train.picture_cameras", lambda *_: steps.append("picture of the cameras"))
    run("train", dataset, "-o", tmp_path / "out", "--viewer", "--port", 18090, *TRAIN)
    before = ["compiling kernels", "shown", "picture of the cameras"]
    assert steps[0] == "reading the photos" and steps[-23:-20] == before
    assert steps[-20:] == ["step"] * 20
    said = capsys.readouterr().err
    waits, first, bar = (said.index(text) for text in ("waiting for the first step", "first iteration: done", "1/20"))
    assert waits < first < bar
    assert " 0/20" not in said, "no bar, and no estimate, before the first step"
