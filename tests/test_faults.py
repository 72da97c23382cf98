"""Runs that are killed at random moments and resumed end in the same file (slow: processes, not functions)."""

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from test_cli import write_dataset

KILLS = 40


@pytest.mark.slow
def test_killed_at_any_moment_and_resumed(tmp_path: Path) -> None:
    write_dataset(tmp_path / "data")
    arguments = ["train", str(tmp_path / "data"), "--iterations", "400", "--init.random-points", "3000"]
    arguments += ["--checkpoint-every", "5", "--eval-every", "0"]

    def start(out: Path) -> subprocess.Popen[bytes]:
        resume = ["--resume"] if (out / "checkpoint.npz").exists() else []
        command = [sys.executable, "-m", "clsplat", *arguments, "-o", str(out), *resume]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    started = time.perf_counter()
    assert start(tmp_path / "whole").wait() == 0
    whole = time.perf_counter() - started

    moments = random.Random(0)
    kills = finished = 0
    while kills < KILLS:
        # A folder is resumed until its run gets through; then the next one begins.
        out = tmp_path / f"broken{finished}"
        process = start(out)
        try:
            assert process.wait(moments.uniform(0, 0.7 * whole)) == 0
            assert (out / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
            finished += 1
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            kills += 1
    out = tmp_path / f"broken{finished}"
    assert start(out).wait() == 0
    assert (out / "scene.ply").read_bytes() == (tmp_path / "whole" / "scene.ply").read_bytes()
