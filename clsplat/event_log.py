"""The log of a training for TensorBoard."""

import socket
import struct
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any


def event_log(folder: Path, iteration: int) -> Callable[[dict[str, Any]], None] | None:
    """Begin a log for TensorBoard after an iteration.

    tensorboardX's own writer is not used: it writes on a thread, which ends at the first error. The training would
    then wait for that thread without end.

    Parameters
    ----------
    folder : Path
        Created if missing. Each run adds a file to it.
    iteration : int
        TensorBoard hides what earlier files hold about later iterations.

    Returns
    -------
    callable or None
        Appends a record of the log; None where tensorboardX is not installed. Both raise OSError if the file cannot
        be written.
    """
    try:
        from tensorboardX.proto.event_pb2 import Event, SessionLog
        from tensorboardX.proto.summary_pb2 import Summary
        from tensorboardX.record_writer import masked_crc32c
    except ImportError:
        return None
    folder.mkdir(parents=True, exist_ok=True)
    # TensorBoard reads the files of a folder in the order of their names. Runs may start in the same second.
    path = folder / f"events.out.tfevents.{int(time.time()):010d}.{socket.gethostname()}.{iteration}"

    def write(event: Any) -> None:
        event.wall_time = time.time()
        data = event.SerializeToString()
        length = struct.pack("<Q", len(data))  # the frame of a TFRecord: length, data, and a checksum of each
        checks = [struct.pack("<I", masked_crc32c(part)) for part in (length, data)]
        with path.open("ab") as file:
            file.write(length + checks[0] + data + checks[1])

    def append(record: dict[str, Any]) -> None:
        values = [Summary.Value(tag=name, simple_value=record[name]) for name in record.keys() - {"iteration"}]
        write(Event(step=record["iteration"], summary=Summary(value=values)))

    write(Event(file_version="brain.Event:2"))
    if iteration:
        write(Event(step=iteration + 1, session_log=SessionLog(status=SessionLog.START)))
    return append
