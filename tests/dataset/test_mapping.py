"""The global mapper: it finds the cameras of photos that were rendered, and repeats to the bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_reconstruction import CONFIG, FILES, cameras, take_photos

from clsplat.config import DataConfig, SfmConfig
from clsplat.dataset import load_scene
from clsplat.dataset.sfm.reconstruction import GLOBAL_PHOTOS, _resolved, read_record, reconstruct


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """The same photos in two folders, both with a model."""
    result = []
    photos = take_photos(0)
    for _ in range(2):
        folder = tmp_path_factory.mktemp("global")
        for k, photo in enumerate(photos):
            Image.fromarray(photo).save(folder / f"photo {k}.png")
        reconstruct(folder, replace(CONFIG, mapper="global"))
        result.append(folder)
    return result


def test_known_cameras_are_recovered(folders: list[Path]) -> None:
    scene = load_scene(folders[0], DataConfig(test_every=0))
    found, true = (np.array([c.position for c in cs]) for cs in ([v.camera for v in scene.train], cameras()))
    apart = [np.linalg.norm(p[:, None] - p[None], axis=2)[np.triu_indices(4, 1)] for p in (found, true)]
    ratios = apart[0] / apart[1]
    # Measured: 0.1 %. A pixel at this focal length is 0.3 % of the distance.
    assert ratios.std() / ratios.mean() < 0.005 and len(scene.points) > 1000


def test_it_repeats_and_is_recorded(folders: list[Path]) -> None:
    models = [[(folder / "sparse" / "0" / name).read_bytes() for name in FILES] for folder in folders]
    assert models[0] == models[1]
    record = read_record(folders[0])
    assert record is not None and record["options"]["mapper"] == "global"
    before = (folders[0] / "sparse" / "0" / FILES[0]).stat().st_mtime_ns
    reconstruct(folders[0], replace(CONFIG, mapper="global"))
    assert (folders[0] / "sparse" / "0" / FILES[0]).stat().st_mtime_ns == before


def test_many_photos_are_mapped_globally(tmp_path: Path) -> None:
    assert _resolved(SfmConfig(), tmp_path, GLOBAL_PHOTOS - 1).mapper == "incremental"
    assert _resolved(SfmConfig(), tmp_path, GLOBAL_PHOTOS).mapper == "global"
    assert _resolved(SfmConfig(mapper="incremental"), tmp_path, GLOBAL_PHOTOS).mapper == "incremental"
