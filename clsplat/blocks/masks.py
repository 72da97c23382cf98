"""Masks of what moves in photos, as the coarse run has found them, in a file that is named by its digest."""

import io
from pathlib import Path

import numpy as np

from clsplat.atomic import replacing
from clsplat.blocks.jobs import Job, digest_of
from clsplat.errors import InputError
from clsplat.training.moving import Masks
from clsplat.training.moving_files import packed, read_masks


def write_masks(found: Masks, folder: Path) -> str:
    """Write masks into a folder; return the name of the file, which is empty if nothing moves."""
    if not found:
        return ""
    content = io.BytesIO()
    np.savez(content, **packed(found))
    path = folder / _name(content.getvalue())
    with replacing(path) as file:
        file.write(content.getvalue())
    return path.name


def masks_of(job_file: Path, job: Job) -> Masks:
    """Read the masks of a job's photos, and of others; there are none if nothing moves.

    Raises
    ------
    InputError
        If their file cannot be read or has been changed.
    """
    if not job.moving:
        return {}
    path = job_file.with_name(job.moving)
    found = read_masks(path)
    if _name(path.read_bytes()) != path.name:
        raise InputError(f"{path}: expected masks as they were written, found a changed file; plan the run again")
    return found


def _name(content: bytes) -> str:
    return f"moving-{digest_of(content)}.npz"
