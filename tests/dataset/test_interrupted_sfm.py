"""Structure from motion that was terminated or killed."""

import fcntl
import os
import signal
import subprocess
import sys

import pytest
from textured_corner import CONFIG

from clsplat.dataset.sfm.reconstruction import LOCK, WORK, reconstruct

STUCK = """
import signal, sys
from clsplat.cli import main
from clsplat.dataset.sfm import reconstruction

def stuck(*_):
    print("ready", flush=True)
    signal.pause()

reconstruction._solved = stuck
main(["sfm", sys.argv[1], "--camera-model", "PINHOLE"])
"""


def interrupted(folder, number):
    """Structure from motion that gets a signal once pycolmap is loaded: its messages and its status."""
    with subprocess.Popen(
        [sys.executable, "-c", STUCK, str(folder)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    ) as process:
        assert process.stdout.readline() == "ready\n"
        process.send_signal(number)
        return process.stderr.read(), process.wait()


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_terminated_run_leaves_nothing(copy, number, status):
    before = sorted(os.listdir(copy))
    messages, returned = interrupted(copy, number)
    assert returned == status
    assert "clsplat: " in messages and "Aborted at" not in messages and "    @ " not in messages
    assert sorted(os.listdir(copy)) == before


def test_what_a_killed_run_left_is_removed_by_the_next(copy, runs):
    interrupted(copy, signal.SIGKILL)
    assert len([name for name in os.listdir(copy) if name.startswith(WORK)]) == 1
    alive = copy / f"{WORK}alive"
    alive.mkdir()
    with (alive / LOCK).open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        reconstruct(copy, CONFIG)
        assert [name for name in os.listdir(copy) if name.startswith(WORK)] == [alive.name]
    reconstruct(copy, CONFIG)
    assert not alive.exists() and runs == []
