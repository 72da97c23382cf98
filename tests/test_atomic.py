"""Atomic writing: the order in which bytes and names reach the disk, names of parts, and their removal."""

import os
from pathlib import Path
from typing import Any

import pytest

from clsplat.atomic import PART, remove_parts, replacing
from clsplat.errors import InputError

NEEDS_FOLDERS = pytest.mark.skipif(os.name == "nt", reason="Windows opens no folders")


@NEEDS_FOLDERS
def test_bytes_reach_the_disk_before_the_name_and_the_folder_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What a power cut leaves is decided by this order alone; no test can cut the power."""
    done: list[str] = []
    sync, replace = os.fsync, os.replace

    def synced(handle: int) -> None:
        status = os.fstat(handle)
        folder = (status.st_dev, status.st_ino) == (tmp_path.stat().st_dev, tmp_path.stat().st_ino)
        done.append("folder" if folder else f"file of {status.st_size} bytes")
        sync(handle)

    def replaced(source: Any, target: Any) -> None:
        done.append(f"name {Path(target).name}")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    with replacing(tmp_path / "a.bin") as file:
        file.write(b"12345")
    assert done == ["file of 5 bytes", "name a.bin", "folder"]
    assert (tmp_path / "a.bin").read_bytes() == b"12345"


@NEEDS_FOLDERS
def test_a_file_system_that_syncs_no_folders_is_no_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sync = os.fsync

    def refusing(handle: int) -> None:
        if os.path.samestat(os.fstat(handle), tmp_path.stat()):
            raise OSError(22, "Invalid argument")
        sync(handle)

    monkeypatch.setattr(os, "fsync", refusing)
    with replacing(tmp_path / "a.bin") as file:
        file.write(b"new")
    assert (tmp_path / "a.bin").read_bytes() == b"new"


def test_a_file_that_does_not_reach_the_disk_replaces_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "a.bin").write_bytes(b"old")

    def failing(handle: int) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", failing)
    with pytest.raises(InputError, match=r"cannot write .*a\.bin: Input/output error"):
        with replacing(tmp_path / "a.bin") as file:
            file.write(b"new")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == {"a.bin": b"old"}


def test_two_writers_of_a_file_have_parts_of_their_own(tmp_path: Path) -> None:
    """Also two processes of one number, on machines that share the folder."""
    with replacing(tmp_path / "a.bin") as first, replacing(tmp_path / "a.bin") as second:
        first.write(b"1111")
        second.write(b"22")
        parts = [p.name for p in tmp_path.iterdir()]
        assert len(parts) == 2 and all(PART.fullmatch(name) for name in parts)
    assert (tmp_path / "a.bin").read_bytes() == b"1111"  # the outer one ends last


def test_a_name_may_be_as_long_as_the_file_system_allows(tmp_path: Path) -> None:
    path = tmp_path / ("a" * 251 + ".bin")
    with replacing(path) as file:
        file.write(b"12345")
    assert path.read_bytes() == b"12345"


def test_only_parts_are_removed(tmp_path: Path) -> None:
    kept = {"scene.ply", ".hidden", ".mine.part", "film.part", "below"}
    for name in kept - {"below"}:
        (tmp_path / name).write_text("")
    (tmp_path / "below").mkdir()
    part = f".checkpoint.npz.{'0a' * 8}.part"
    for folder in (tmp_path, tmp_path / "below"):
        (folder / part).write_text("half")
    remove_parts(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == kept
    assert (tmp_path / "below" / part).exists(), "it may be of another run"
