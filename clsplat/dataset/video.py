"""Extract photos from a video: the sharpest frame of each of equal time intervals. PyAV decodes the video."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.dataset.photos import FRAMES, SHARPNESS_EDGE, sharpness
from clsplat.errors import InputError

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Suffixes, in lower case, of the files that count as videos."""

QUALITY = 95
"""JPEG quality of the extracted frames, 0 to 100. The loss is smaller than that of the video's own compression."""


def is_video(path: Path) -> bool:
    """Whether `path` is a file with a suffix of `SUFFIXES`."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def extract_frames(video: Path, folder: Path, per_second: float = 2.0) -> int:
    """Write the sharpest frame of each interval of a video as JPEG, or reuse the frames of an earlier call.

    Parameters
    ----------
    video : Path
        Any file that FFmpeg decodes.
    folder : Path
        New or empty folder for the frames, whose names sort in their order. If it holds the frames of an earlier call
        with the same video and `per_second`, it is left unchanged.
    per_second : float
        Intervals per second of video.

    Returns
    -------
    int
        Number of frames, at least 1.

    Raises
    ------
    InputError
        If PyAV is missing, the video cannot be decoded or has no frames, or the folder holds other files or cannot be
        written.
    """
    if not (0 < per_second < np.inf):
        raise InputError(f"fps: expected a number above 0, found {per_second}")
    try:
        import av
    except ImportError as error:
        raise InputError(
            f"cannot read {video}: the package av (PyAV) is not installed; pip install 'clsplat[video]'"
        ) from error
    if not video.is_file():
        raise InputError(f"{video}: expected a video, found {'a folder' if video.is_dir() else 'nothing'}")
    made_from = {"video": video.name, "bytes": video.stat().st_size, "fps": per_second}
    if folder.exists() and any(folder.iterdir()):
        return _existing_frames(folder, made_from)
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=".clsplat_frames_", dir=folder.parent))
    except OSError as error:
        raise InputError(f"cannot create {folder}: {error.strerror}") from error
    try:
        count = 0
        for pixels in _sharpest(video, per_second):
            count += 1
            _save(work / f"frame_{count:05d}.jpg", pixels)
        if count == 0:
            raise InputError(f"{video}: expected a video with frames, found none")
        (work / FRAMES).write_text(json.dumps({**made_from, "frames": count}, indent=1), encoding="utf-8")
        work.chmod(0o755)  # mkdtemp permits access to the owner only
        if folder.exists():
            folder.rmdir()
        os.replace(work, folder)
    except av.error.FFmpegError as error:
        raise InputError(f"cannot read {video} as a video: {error.strerror}") from error
    finally:
        shutil.rmtree(work, ignore_errors=True)
    return count


def _existing_frames(folder: Path, made_from: dict[str, Any]) -> int:
    """Count the frames in a folder that is not empty.

    Raises
    ------
    InputError
        If they were not extracted from the video and at the rate in `made_from`.
    """
    record = _read_record(folder)
    if {key: record.get(key) for key in made_from} != made_from:
        raise InputError(
            f"{folder}: expected a new or empty folder, or frames of {made_from['video']} taken "
            f"{made_from['fps']:g} times a second, found other files; remove it, or choose another folder with -o"
        )
    return int(record["frames"])


def _read_record(folder: Path) -> dict[str, Any]:
    """Read the video, its size and the rate from which a folder's frames were extracted; empty if not recorded."""
    try:
        record = json.loads((folder / FRAMES).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _sharpest(video: Path, per_second: float) -> Iterator[NDArray[np.uint8]]:
    """Yield the sharpest frame of each interval: upright, (H, W, 3) RGB."""
    import av

    with av.open(str(video)) as container:
        if not container.streams.video:
            raise InputError(
                f"{video}: expected a video stream, found {len(container.streams)} streams of other kinds"
            )
        stream = container.streams.video[0]
        stream.thread_type = "AUTO"
        rate = float(stream.average_rate or stream.guessed_rate or 25)  # for frames without a time; 25/s as in PAL
        best: Any = None
        best_score, interval = -1.0, -1
        start: float | None = None
        for index, frame in enumerate(container.decode(stream)):
            time = index / rate if frame.time is None else frame.time
            start = time if start is None else start
            current = int((time - start) * per_second + 1e-9)
            if current != interval and best is not None:
                yield _upright(best)
                best_score = -1.0
            interval = current
            scale = min(1.0, SHARPNESS_EDGE / max(frame.width, frame.height))
            small = frame.reformat(max(2, round(frame.width * scale)), max(2, round(frame.height * scale)), "gray")
            score = sharpness(small.to_ndarray())
            if score > best_score:
                best, best_score = frame, score
        if best is not None:
            yield _upright(best)


def _upright(frame: Any) -> NDArray[np.uint8]:
    pixels: NDArray[np.uint8] = frame.to_ndarray(format="rgb24")
    # Phones store frames in the orientation of the sensor, with the counter-clockwise angle by which to turn them.
    return np.ascontiguousarray(np.rot90(pixels, round(frame.rotation / 90)))


def _save(path: Path, pixels: NDArray[np.uint8]) -> None:
    from PIL import Image

    try:
        Image.fromarray(pixels).save(path, quality=QUALITY, subsampling=0)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error.strerror or error}") from error
