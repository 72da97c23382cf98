"""Memory that the process may take: the machine's, or less in a container."""

from pathlib import Path

import pytest

from clsplat import host_memory
from clsplat.host_memory import physical_memory


@pytest.fixture(autouse=True)
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of control groups, of which the process is in none."""
    monkeypatch.setattr(host_memory, "GROUPS", tmp_path)
    monkeypatch.setattr(host_memory, "OWN_GROUPS", tmp_path / "own")
    return tmp_path


def limit(groups: Path, own: str, **limits: str) -> int | None:
    """Memory in groups of these names, with __ for a slash."""
    (groups / "own").write_text(own)
    for name, text in limits.items():
        path = groups / name.replace("__", "/").replace("_max", ".max").replace("_limit", ".limit")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"{text}\n")
    return physical_memory()


def test_a_machine_without_control_groups_has_its_own_memory() -> None:
    found = physical_memory()
    assert found is None or found > 1 << 28


@pytest.mark.skipif(physical_memory() is None, reason="the system does not tell its memory")
def test_the_least_limit_of_a_control_group_counts(groups: Path) -> None:
    machine = physical_memory()
    assert limit(groups, "0::/a/b\n", memory_max="max") == machine
    assert limit(groups, "0::/a/b\n", a__memory_max="5000") == 5000, "of the group around"
    assert limit(groups, "0::/a/b\n", a__b__memory_max="4000") == 4000
    assert limit(groups, "0::/\n", memory_max="6000") == 6000, "a container's root"
    assert limit(groups, "0::/../elsewhere\n") == 6000
    assert limit(groups, "0::/a/b\n", memory_max=str(1 << 62), a__memory_max="max", a__b__memory_max="max") == machine
    assert limit(groups, "1:name=systemd:/\n4:cpu,memory:/docker/1\n", memory__memory_limit_in_bytes="3000") == 3000
    assert limit(groups, "4:memory:/a\n", memory__a__memory_limit_in_bytes="2000") == 2000
    assert limit(groups, "what is this") == machine
