"""The .glb of glTF with KHR_gaussian_splatting: its bytes, scenes of several meshes, integers, broken files."""

import json
import struct

import numpy as np
import pytest
from bounds import assert_within, random_gaussians
from foreign_code import validated
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.formats import quantisation
from clsplat.formats.glb_container import read_chunks
from clsplat.formats.gltf import load_glb, save_glb
from clsplat.gaussians import Gaussians
from clsplat.reference.sh import sh_basis

KHR = "KHR_gaussian_splatting"


def pack(document, binary=b"", version=2, magic=b"glTF"):
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    body = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", magic, version, 12 + len(body)) + body


def saved(path, gaussians, *rest):
    """Save a .glb; return its JSON and its numbers."""
    save_glb(path, gaussians, *rest)
    return read_chunks(path, path.read_bytes())


def changed(path, gaussians, change):
    """Save a .glb whose JSON is changed by a function."""
    document, binary = saved(path, gaussians)
    change(document)
    path.write_bytes(pack(document, binary))
    return path


def test_what_is_written(tmp_path):
    path = tmp_path / "a.glb"
    gaussians = random_gaussians(7, 1)
    document, binary = saved(path, gaussians, "antialiased", [1e6, 0.25, 0])
    assert document["extensionsUsed"] == [KHR]
    assert document["asset"]["extras"] == {"clsplat": {"mode": "antialiased", "offset": [1e6, 0.25, 0]}}
    (primitive,) = document["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"][KHR] == {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}

    def column(name):
        accessor = document["accessors"][primitive["attributes"][name]]
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        return np.frombuffer(binary[view["byteOffset"] :][: view["byteLength"]], dtype).reshape(7, -1)

    # Left, up, forward: x and y have the opposite sign.
    np.testing.assert_array_equal(column("POSITION"), gaussians.means * np.float32([-1, -1, 1]))
    np.testing.assert_array_equal(column(f"{KHR}:ROTATION"), gaussians.quats[:, [1, 2, 3, 0]] * [-1, -1, 1, 1])
    np.testing.assert_allclose(column(f"{KHR}:SCALE"), gaussians.scales, rtol=1e-6)
    np.testing.assert_allclose(column(f"{KHR}:OPACITY")[:, 0], gaussians.opacities, rtol=1e-6)
    np.testing.assert_array_equal(column(f"{KHR}:SH_DEGREE_0_COEF_0"), gaussians.sh[:, 0])
    # Basis functions y, z, x.
    for n, sign in enumerate((-1, 1, -1)):
        np.testing.assert_array_equal(column(f"{KHR}:SH_DEGREE_1_COEF_{n}"), sign * gaussians.sh[:, 1 + n])
    assert column("COLOR_0").shape == (7, 4)
    accessor = document["accessors"][primitive["attributes"]["POSITION"]]
    np.testing.assert_array_equal(np.float32(accessor["min"]), column("POSITION").min(axis=0))


def test_nodes_place_meshes(tmp_path):
    """A turned, scaled and shifted node below another one: the colours along a turned direction stay."""
    gaussians = random_gaussians(20, 3)
    turn = Rotation.from_rotvec([0.3, -1.0, 2.0])

    def place(document):
        document["nodes"] = [
            {"children": [1], "translation": [1, 2, 3]},
            {"mesh": 0, "rotation": turn.as_quat().tolist(), "scale": [2, 2, 2]},
        ]

    found = load_glb(changed(tmp_path / "a.glb", gaussians, place))[0]
    half = np.diag([-1.0, -1.0, 1.0])
    matrix = half @ turn.as_matrix() @ half  # in the axes of a PLY
    np.testing.assert_allclose(found.means, 2 * gaussians.means @ matrix.T + [-1, -2, 3], atol=1e-5)
    np.testing.assert_allclose(found.log_scales, gaussians.log_scales + np.log(2), atol=1e-5)
    directions = np.random.default_rng(0).normal(size=(9, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", sh_basis(directions, 3), gaussians.sh)
    after = np.einsum("dk,nkc->ndc", sh_basis(directions @ matrix.T, 3), found.sh)
    np.testing.assert_allclose(after, before, atol=1e-5)
    axes = Rotation.from_quat(np.roll(found.quats, -1, axis=1)).as_matrix()
    old = Rotation.from_quat(np.roll(gaussians.quats, -1, axis=1)).as_matrix()
    np.testing.assert_allclose(axes, matrix @ old, atol=1e-5)


def test_meshes_of_different_degrees_become_one_scene(tmp_path):
    path = tmp_path / "a.glb"
    gaussians = random_gaussians(5, 2)

    def twice(document):
        mesh = json.loads(json.dumps(document["meshes"][0]))
        attributes = mesh["primitives"][0]["attributes"]
        for name in [name for name in attributes if "_DEGREE_0" not in name and "_DEGREE" in name]:
            del attributes[name]
        points = {"primitives": [{"attributes": {"POSITION": 0}, "mode": 0}]}
        document["meshes"] += [mesh, points]
        matrix = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]  # by columns
        document["nodes"] = [{"mesh": 0}, {"mesh": 1, "matrix": matrix}, {"mesh": 2}, {"mesh": 0}]
        document["scenes"][0]["nodes"] = [2, 1, 0]

    found = load_glb(changed(path, gaussians, twice))[0]
    assert found.sh.shape == (10, 9, 3)
    first, second = found.take(found.sh[:, 1:].any(axis=(1, 2))), found.take(~found.sh[:, 1:].any(axis=(1, 2)))
    np.testing.assert_array_equal(first.means, gaussians.means)
    np.testing.assert_array_equal(second.means, gaussians.means - np.float32([5, 0, 0]))


def test_without_a_scene_all_meshes_are_read(tmp_path):
    def lone(document):
        del document["scenes"], document["scene"], document["nodes"]

    gaussians = random_gaussians(3, 0)
    assert_within(load_glb(changed(tmp_path / "a.glb", gaussians, lone))[0], gaussians, (0, 1e-6, 0, 0, 0, 0))


def test_integers_are_fractions(tmp_path):
    """Positions by KHR_mesh_quantization, the others as the specification allows, with gaps between the rows."""
    rows = np.zeros(2, [("p", "<i2", 4), ("r", "i1", 4), ("s", "<u2", 3), ("o", "u1", 2), ("c", "<f4", 3)])
    rows["p"][:, :3] = [[1, -2, 3], [4, 5, 6]]
    rows["r"] = [[0, 0, 0, 127], [127, 0, 0, -128]]
    rows["s"] = [[65535, 0, 6553], [1, 2, 3]]
    rows["o"][:, 0] = [0, 255]
    rows["c"] = 0.5
    kinds = {
        "POSITION": ("p", 5122, "VEC3"),
        f"{KHR}:ROTATION": ("r", 5120, "VEC4"),
        f"{KHR}:SCALE": ("s", 5123, "VEC3"),
    }
    kinds |= {f"{KHR}:OPACITY": ("o", 5121, "SCALAR"), f"{KHR}:SH_DEGREE_0_COEF_0": ("c", 5126, "VEC3")}
    accessors = [
        {"bufferView": 0, "byteOffset": rows.dtype.fields[field][1], "componentType": code, "count": 2, "type": kind}
        | ({"normalized": True} if field in "rso" else {})
        for field, code, kind in kinds.values()
    ]
    attributes = {name: k for k, name in enumerate(kinds)}
    document = {
        "asset": {"version": "2.0"},
        "extensionsRequired": ["KHR_mesh_quantization"],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": 0, "extensions": {KHR: {}}}]}],
        "buffers": [{"byteLength": rows.nbytes}],
        "bufferViews": [{"buffer": 0, "byteLength": rows.nbytes, "byteStride": rows.itemsize}],
        "accessors": accessors,
    }
    (tmp_path / "a.glb").write_bytes(pack(document, rows.tobytes()))
    found = load_glb(tmp_path / "a.glb")[0]
    np.testing.assert_array_equal(found.means, [[-1, 2, 3], [-4, -5, 6]])
    np.testing.assert_allclose(found.scales[0], [1, 0, 0.1], atol=1e-4)
    np.testing.assert_allclose(found.opacities, [0, 1], atol=1e-6)
    half = 0.5**0.5
    np.testing.assert_allclose(found.quats, [[1, 0, 0, 0], [-half, -half, 0, 0]], atol=1e-6)


def setting(*path, value):
    """A change of the JSON at a path."""

    def change(document):
        place = document
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value

    return change


BROKEN = {
    "compressed": (setting("extensionsRequired", value=[f"{KHR}_compression_other"]), "without further extensions"),
    "no splats": (setting("meshes", 0, "primitives", 0, "extensions", value={}), "is it a mesh"),
    "no scale": (setting("meshes", 0, "primitives", 0, "attributes", value={"POSITION": 0}), f"missing {KHR}:SCALE"),
    "mirror": (setting("nodes", 0, "scale", value=[1, 1, -1]), "rotate, shift and scale alike"),
    "shear": (setting("nodes", 0, "scale", value=[1, 2, 1]), "rotate, shift and scale alike"),
    "flat": (setting("nodes", 0, "scale", value=[0, 0, 0]), "rotate, shift and scale alike"),
    "no number": (setting("nodes", 0, "translation", value=[0, 0, "x"]), "damaged"),
    "infinite": (setting("nodes", 0, "translation", value=[0, 0, 1e999]), "damaged"),
    "cycle": (setting("nodes", 0, "children", value=[0]), "one parent each, found node 0 twice"),
    "no such node": (setting("scenes", 0, "nodes", value=[7]), "damaged"),
    "sparse": (setting("accessors", 0, "sparse", value={}), "stored in full"),
    "elsewhere": (setting("buffers", 0, "uri", value="a.bin"), "in the file itself"),
    "width": (setting("accessors", 0, "type", value="VEC4"), "3 numbers per row of POSITION, found 4"),
    "type": (setting("accessors", 0, "componentType", value=5130), "damaged"),
    "counts": (setting("accessors", 0, "count", value=3), "as many rows"),
    "beyond the view": (setting("bufferViews", 0, "byteLength", value=5), "expected 4 rows of POSITION"),
    "beyond the file": (setting("bufferViews", 0, "byteOffset", value=10**6), "bytes of numbers"),
    "negative": (setting("accessors", 0, "byteOffset", value=-4), "expected 4 rows"),
    "overlapping": (setting("bufferViews", 0, "byteStride", value=0), "expected 4 rows"),
    "list": (setting("accessors", value=3), "damaged"),
    "offset": (setting("asset", "extras", value={"clsplat": {"offset": [1, 2]}}), "damaged"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_is_one_sentence(tmp_path, case):
    change, message = BROKEN[case]
    path = changed(tmp_path / "a.glb", random_gaussians(4, 1), change)
    with pytest.raises(InputError, match=message) as caught:
        load_glb(path)
    text = str(caught.value)
    assert text.startswith((f"{path}: ", f"cannot read {path}: ")) and len(text.splitlines()) == 1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pack({}, magic=b"glTX"), "begins with glTF"),
        (pack({}, version=1), "version 2, found version 1"),
        (pack({}) + b"x", "bytes as the header declares"),
        (pack({})[:-1], "is it truncated"),
        (struct.pack("<4sII", b"glTF", 2, 12), "a chunk of JSON, found none"),
        (struct.pack("<4sII4s", b"glTF", 2, 16, b"JSON"), "the file is damaged"),
        (struct.pack("<4sIII4s", b"glTF", 2, 20, 9, b"JSON"), "a chunk of 9 bytes"),
        (pack([]), "damaged"),
        (pack({"meshes": []}), "is it a mesh"),
    ],
)
def test_a_broken_container_is_one_sentence(tmp_path, content, message):
    (tmp_path / "a.glb").write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_glb(tmp_path / "a.glb")


def test_nested_json_is_refused(tmp_path):
    text = b"[" * 200_000
    (tmp_path / "a.glb").write_bytes(struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text), len(text), b"JSON") + text)
    with pytest.raises(InputError, match="damaged"):
        load_glb(tmp_path / "a.glb")


def test_many_primitives_of_one_array_are_refused(tmp_path, monkeypatch):
    def many(document):
        document["meshes"][0]["primitives"] *= 300

    path = changed(tmp_path / "a.glb", random_gaussians(50, 0), many)
    assert len(load_glb(path)[0]) == 15000  # too small to exhaust memory
    monkeypatch.setattr(quantisation, "EXPANSION_FREE", 1 << 10)
    monkeypatch.setattr(quantisation, "EXPANSION_MAX", 3)
    with pytest.raises(InputError, match="exhaust memory"):
        load_glb(path)


def test_another_kernel_is_read_with_a_warning(tmp_path):
    change = setting("meshes", 0, "primitives", 0, "extensions", KHR, value={"kernel": "x", "colorSpace": "y"})
    with pytest.warns(UserWarning, match="the kernel 'x' with colours in 'y'"):
        load_glb(changed(tmp_path / "a.glb", random_gaussians(4, 1), change))


def test_what_a_glb_cannot_hold(tmp_path, monkeypatch):
    gaussians = random_gaussians(2, 0)
    gaussians.log_scales[1] = 90
    with pytest.raises(InputError, match=r"scales that float32 can hold, found log_scales = 90"):
        save_glb(tmp_path / "a.glb", gaussians)
    monkeypatch.setattr("clsplat.formats.gltf.SIZE_MAX", 1000)
    with pytest.raises(InputError, match="at most 1000 bytes"):
        save_glb(tmp_path / "a.glb", random_gaussians(99, 3))
    assert not list(tmp_path.iterdir())


def test_no_direction_stays_invisible_in_a_turned_node(tmp_path):
    path = tmp_path / "a.glb"
    document, binary = saved(path, random_gaussians(2, 0))
    document["nodes"][0]["rotation"] = [1, 0, 0, 0]
    view = document["bufferViews"][document["meshes"][0]["primitives"][0]["attributes"][f"{KHR}:ROTATION"]]
    start = view["byteOffset"]
    path.write_bytes(pack(document, binary[:start] + bytes(16) + binary[start + 16 :]))
    found = load_glb(path)[0]
    assert found.opacities[0] < 1e-6 and isinstance(found, Gaussians)


@pytest.mark.foreign
@pytest.mark.parametrize("degree", [0, 3])
def test_the_validator_of_khronos_finds_no_fault(tmp_path, degree):
    """It does not know the extension: that, and the colons that the extension's names have, is all it reports."""
    save_glb(tmp_path / "a.glb", random_gaussians(100, degree), "antialiased", [1, 2, 3])
    for message in validated(tmp_path / "a.glb"):
        unknown = message["code"] == "UNSUPPORTED_EXTENSION" and KHR in message["message"]
        assert unknown or (message["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and f"/{KHR}:" in message["pointer"])
