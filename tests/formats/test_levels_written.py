"""Levels of detail as files: a streamed SOG and 3D Tiles, read back, bounded, and found broken in one sentence."""

import json
import shutil

import numpy as np
import pytest
from bounds import matched, random_gaussians
from cli_runs import fails, run
from foreign_code import splat_transform

from clsplat.errors import InputError
from clsplat.formats import anatomy_of, load_gaussians, save_gaussians
from clsplat.formats.axes import LEFT_UP_FORWARD, turned
from clsplat.formats.gltf import load_glb
from clsplat.formats.gltf_spz import save_spz_glb
from clsplat.formats.sog import load_sog
from clsplat.formats.streamed_sog import LOD_META, StreamedSogWriter
from clsplat.formats.tiles_3d import TILESET, TilesWriter
from clsplat.pruning.levels import detail_tree

OFFSET = np.array([1000.0, -2000.0, 0.5])


@pytest.fixture(scope="module")
def scene():
    return random_gaussians(700, 2)


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    """Both formats in one folder; tests must not change it."""
    folder = tmp_path_factory.mktemp("levels")
    writers = [kind(folder, "antialiased", OFFSET) for kind in (StreamedSogWriter, TilesWriter)]
    for node in detail_tree(scene):
        for writer in writers:
            writer.add(node)
    for writer in writers:
        writer.finish()
    return folder


@pytest.fixture
def written(folder, tmp_path):
    """A copy that a test may change."""
    return shutil.copytree(folder, tmp_path / "copy")


@pytest.mark.parametrize(("name", "error"), [(LOD_META, 1e-3), (TILESET, 1e-3)])
def test_the_finest_level_is_read_back(scene, written, name, error):
    found, mode, offset = load_gaussians(written / name)
    assert mode == "antialiased" and (offset == OFFSET).all() and found.sh.shape == scene.sh.shape
    found = matched(found, scene)
    assert np.abs(found.means - scene.means).max() <= error * np.abs(scene.means).max()
    assert sum(anatomy_of(written / name).parts.values()) > 0


@pytest.mark.parametrize(("kind", "name"), [(StreamedSogWriter, LOD_META), (TilesWriter, TILESET)])
def test_an_export_that_ends_early_leaves_no_mixture_of_scenes(scene, written, kind, name):
    writer = kind(written)
    assert (written / name).exists()
    writer.add(next(iter(detail_tree(scene.take(np.arange(600))))))
    assert not (written / name).exists()
    with pytest.raises(InputError):
        load_gaussians(written / name)


def test_the_tree_of_a_streamed_sog(scene, written):
    meta = json.loads((written / LOD_META).read_text())
    assert meta["version"] == 1 and meta["lodLevels"] == 4 and meta["counts"][0] == len(scene)
    assert meta["count"] == sum(meta["counts"])
    leaves, waiting = [], [meta["tree"]]
    while waiting:
        node = waiting.pop()
        waiting += node.get("children", [])
        if "lods" in node:
            leaves.append(node)
    assert len(leaves) == 8
    for leaf in leaves:
        assert sorted(leaf["lods"]) == ["0", "1", "2", "3"]
        for lod in leaf["lods"].values():
            gaussians = load_sog(written / meta["filenames"][lod["file"]])[0]
            means = gaussians.means[lod["offset"] : lod["offset"] + lod["count"]]
            assert len(means) == lod["count"] > 0
            low, high = (np.array(leaf["bound"][side]) for side in ("min", "max"))
            slack = 1e-3 * np.abs(scene.means).max()  # of the quantisation
            assert (means >= low - slack).all() and (means <= high + slack).all()


def test_the_tree_of_tiles(scene, written):
    tileset = json.loads((written / TILESET).read_text())
    seen = []

    def visit(tile, parent):
        numbers = np.array(tile["boundingVolume"]["box"])
        centre, half = numbers[:3], numbers[3:].reshape(3, 3)
        gaussians = load_glb(written / tile["content"]["uri"])[0]
        seen.append(len(gaussians))
        x, y, z = turned(gaussians, LEFT_UP_FORWARD).means.T  # as in the file, whose y viewers turn to z
        inside = np.abs((np.stack([x, -z, y], axis=1) - centre) @ np.linalg.inv(half).T)
        assert inside.max() <= 1 + 1e-5  # single precision
        assert tile["refine"] == "REPLACE" and tile["geometricError"] <= parent
        children = tile.get("children", [])
        assert len(children) in (0, 2) and (tile["geometricError"] == 0) == (not children)
        for child in children:
            visit(child, tile["geometricError"])

    visit(tileset["root"], tileset["geometricError"])
    # What is not drawn at all has an error of the scene's size; or else it would disappear from nearby.
    assert tileset["geometricError"] >= np.ptp(scene.means, axis=0).max()
    assert len(seen) == 15
    content = tileset["extensions"]["3DTILES_content_gltf"]
    needed = [
        "KHR_gaussian_splatting",
        "KHR_gaussian_splatting_compression_spz_2",
    ]  # both, or CesiumJS draws no splats
    assert content["extensionsRequired"] == needed and tileset["asset"]["version"] == "1.1"


def test_a_compressed_glb_has_the_values_of_an_spz(scene, tmp_path):
    save_gaussians(tmp_path / "a.spz", scene)
    save_spz_glb(tmp_path / "a.glb", scene, "antialiased", OFFSET)
    found, mode, offset = load_gaussians(tmp_path / "a.glb")
    assert mode == "antialiased" and (offset == OFFSET).all()
    expected = matched(load_gaussians(tmp_path / "a.spz")[0], scene).arrays()
    values = matched(found, scene).arrays()
    values["quats"] *= np.sign((values["quats"] * expected["quats"]).sum(axis=1, keepdims=True))  # the same rotation
    for name, array in values.items():
        np.testing.assert_array_equal(array, expected[name])
    assert anatomy_of(tmp_path / "a.glb").parts["all values, as .spz"] > 700 * 20
    data = bytearray((tmp_path / "a.glb").read_bytes())
    data[-200:] = bytes(200)
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(InputError, match=r"a\.glb"):
        load_gaussians(tmp_path / "a.glb")


BROKEN = {
    "no root": ({"root": None}, "its tileset.json is damaged"),
    "empty": ({"root": {}}, "expected tiles with contents"),
    "above": ({"root": {"content": {"uri": "../a.glb"}}}, "expected contents beside tileset.json"),
    "number": ({"root": {"content": {"uri": 3}}}, "damaged"),
    "moved": ({"root": {"transform": [1]}}, "found a tile with a transform"),
    "missing": ({"root": {"content": {"uri": "none.glb"}}}, "No such file"),
    "deep": ({"root": {"children": 7}}, "damaged"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_tileset_is_one_sentence(written, case):
    change, message = BROKEN[case]
    tileset = json.loads((written / TILESET).read_text())
    (written / TILESET).write_text(json.dumps(tileset | change))
    with pytest.raises(InputError, match=message) as caught:
        load_gaussians(written / TILESET)
    assert len(str(caught.value).splitlines()) == 1


def test_tiles_whose_children_add_to_them_are_read_too(tmp_path):
    """And contents of a list, and names with escapes."""
    parts = {"root a.glb": 50, "b.glb": 60, "c.glb": 7}
    for seed, (name, count) in enumerate(parts.items()):
        save_gaussians(tmp_path / name, random_gaussians(count, seed))
    child = {"contents": [{"uri": "b.glb"}, {"uri": "c.glb"}]}
    root = {"refine": "ADD", "content": {"uri": "root%20a.glb"}, "children": [child]}
    for refine, count in (("ADD", 117), ("REPLACE", 67)):
        (tmp_path / TILESET).write_text(json.dumps({"root": root | {"refine": refine}}))
        assert len(load_gaussians(tmp_path / TILESET)[0]) == count


def test_export_writes_levels(scene, tmp_path, capsys):
    save_gaussians(tmp_path / "a.ply", scene)
    run("export", tmp_path / "a.ply", tmp_path / "both")
    assert "4 levels of 700, " in capsys.readouterr().err
    assert {LOD_META, TILESET} <= {path.name for path in (tmp_path / "both").iterdir()}
    for name, other in ((LOD_META, "*.glb"), (TILESET, "*.webp")):
        run("export", tmp_path / "a.ply", tmp_path / name.split(".")[0] / name)
        folder = tmp_path / name.split(".")[0]
        assert (folder / name).exists() and not list(folder.rglob(other))
        assert (folder / name).read_bytes() == (tmp_path / "both" / name).read_bytes()
    assert "xyz" in fails(capsys, "export", tmp_path / "a.ply", tmp_path / "a.xyz")


@pytest.mark.foreign
def test_splat_transform_reads_what_is_written(written, scene, tmp_path):
    splat_transform(written / LOD_META, tmp_path / "back.ply")
    found = load_gaussians(tmp_path / "back.ply")[0]
    assert len(found) == len(scene)
