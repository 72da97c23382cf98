"""The streamed SOG: its tree, and broken ones. Files of splat-transform: test_made_by_others.py."""

import json
import shutil

import numpy as np
import pytest
from bounds import matched, random_gaussians
from foreign_code import SCRIPTS, splat_transform

from clsplat.errors import InputError
from clsplat.formats import anatomy_of, load_gaussians, save_gaussians
from clsplat.formats.streamed_sog import LOD_META


@pytest.fixture
def folder(tmp_path):
    """Two .sog of different degrees, whose halves are two nodes of a tree, and an environment."""
    for name, n, degree in (("a.sog", 10, 1), ("b.sog", 6, 0), ("sky.sog", 3, 0)):
        save_gaussians(tmp_path / name, random_gaussians(n, degree, seed=n))
    nodes = [
        {"lods": {"1": {"file": 1, "offset": 0, "count": 3}, "0": {"file": 0, "offset": 5, "count": 5}}},
        {"lods": {"0": {"file": 0, "offset": 0, "count": 4}, "2": {"file": 1, "offset": 3, "count": 1}}},
        {"lods": {"1": {"file": 1, "offset": 4, "count": 2}}, "children": []},
        {"lods": {"0": {"file": 1, "offset": 0, "count": 0}}},
    ]
    meta = {"version": 1, "lodLevels": 3, "filenames": ["a.sog", "b.sog"], "tree": {"children": nodes}}
    (tmp_path / LOD_META).write_text(json.dumps(meta | {"environment": "sky.sog"}))
    return tmp_path


def test_the_finest_level_of_each_node_and_the_environment(folder):
    found, mode, offset = load_gaussians(folder)
    a, b, sky = (load_gaussians(folder / name)[0] for name in ("a.sog", "b.sog", "sky.sog"))
    expected = np.concatenate([a.means[5:], a.means[:4], b.means[4:], sky.means])
    np.testing.assert_array_equal(found.means, expected)
    assert found.sh.shape == (14, 4, 3) and not found.sh[9:, 1:].any() and found.sh[:9, 1:].any()
    assert mode == "classic" and not offset.any()
    again = load_gaussians(folder / LOD_META)[0]
    np.testing.assert_array_equal(found.means, again.means)
    anatomy = anatomy_of(folder)
    assert anatomy.format == "streamed SOG (PlayCanvas), 3 levels of detail"
    # The pictures of three scenes, without the directories of their ZIPs.
    assert 0.5 * sum(p.stat().st_size for p in folder.iterdir()) < sum(anatomy.parts.values())


BROKEN = {
    "version": ({"version": 2}, "version 1, found version 2"),
    "no tree": ({"tree": None}, "damaged"),
    "empty": ({"tree": {}}, "expected Gaussians in the tree"),
    "text": ({"tree": {"lods": {"x": 0}}}, "damaged"),
    "bool": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": True}}}}, "damaged"),
    "negative": ({"tree": {"lods": {"0": {"file": 0, "offset": -1, "count": 2}}}}, "damaged"),
    "huge": ({"tree": {"lods": {"0": {"file": 0, "offset": 0, "count": 10**12}}}}, "damaged"),
    "no such file": ({"tree": {"lods": {"0": {"file": 9, "offset": 0, "count": 1}}}}, "names its files wrongly"),
    "too many": ({"tree": {"lods": {"0": {"file": 0, "offset": 8, "count": 3}}}}, "of different scenes or damaged"),
    "above": ({"filenames": ["../a.sog", "b.sog"]}, r"files beside lod-meta.json, found '\.\./a\.sog'"),
    "absolute": ({"filenames": ["/a.sog", "b.sog"]}, "files beside"),
    "number": ({"filenames": [1, 2]}, "names its files wrongly"),
    "environment": ({"environment": "none.sog"}, "No such file"),
    "twice": (
        {"tree": {"children": [{"lods": {"0": {"file": 1, "offset": 0, "count": 6}}}] * 2}},
        "expected b.sog to hold the 12 Gaussians that the tree names, found 6",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_tree_is_one_sentence(folder, case):
    change, message = BROKEN[case]
    meta = json.loads((folder / LOD_META).read_text())
    (folder / LOD_META).write_text(json.dumps(meta | change))
    with pytest.raises(InputError, match=message) as caught:
        load_gaussians(folder)
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize("content", [b"", b"[]", b"{", b"\xff", b"[" * 200_000])
def test_broken_json_is_one_sentence(folder, content):
    (folder / LOD_META).write_bytes(content)
    with pytest.raises(InputError, match=r"its lod-meta\.json is damaged"):
        load_gaussians(folder)


def test_a_missing_part_is_named(tmp_path):
    shutil.copytree(SCRIPTS / "streamed", tmp_path / "scene")
    (tmp_path / "scene" / "0_0" / "quats.webp").unlink()
    with pytest.raises(InputError, match=r"scene.*0_0.*No such file"):
        load_gaussians(tmp_path / "scene")


@pytest.mark.foreign
def test_splat_transform_streams_many_chunks(tmp_path):
    source = random_gaussians(3000, 1)
    source.means *= 20
    np.maximum(source.logit_opacities, -4, out=source.logit_opacities)  # its SOG writer drops colours at opacity 0
    save_gaussians(tmp_path / "a.ply", source)
    (tmp_path / "lod").mkdir()
    options = ("--lod-chunk-count", 1, "--lod-chunk-extent", 5, "--lod-chunk-min", 1)
    splat_transform(*options, tmp_path / "a.ply", "-l", 0, tmp_path / "a.ply", "-l", 1, tmp_path / "lod" / LOD_META)
    found = matched(load_gaussians(tmp_path / "lod")[0], source)
    assert np.abs(found.means - source.means).max() < 0.05
    assert np.abs(found.opacities - source.opacities).max() < 1 / 200
