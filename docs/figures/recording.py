"""Record the three commands of the README in a terminal: docs/_static/recording.gif.

    $ python docs/figures/recording.py PHOTOS     # needs `pip install pyte`; Linux and macOS

The commands run as they stand. Long waits are shortened: a picture is shown for at most `LONGEST`.
"""

import os
import pty
import select
import signal
import sys
import tempfile
import time
from pathlib import Path

import pyte
from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

OUT = Path(__file__).parents[1] / "_static" / "recording.gif"

COLUMNS, LINES, POINTS = 100, 22, 15

COMMANDS = (
    ("clsplat train photos -o scene --iterations 1000", None),
    ("clsplat view scene --port 8090", b"http://"),
    ("clsplat export scene scene.html", None),
)
"""Commands, and the output after which each is interrupted by Ctrl-C; None where it ends by itself."""

STEP = 2.0
"""Seconds of a command between two pictures."""

LONGEST, TYPED, LAST = 160, 60, 2500
"""Milliseconds that a picture of a command is shown, one of typing, and the last one of a command."""

COLORS = {"default": "#d8d8d8", "red": "#ff7b72", "green": "#7ee787", "brown": "#e3b341", "blue": "#79c0ff"}
BACKGROUND = "#16181d"


class Recording:
    """A terminal whose screen becomes pictures."""

    def __init__(self) -> None:
        self.screen = pyte.Screen(COLUMNS, LINES)
        self.stream = pyte.ByteStream(self.screen)
        self.pictures: list[Image.Image] = []
        self.times: list[int] = []
        found = font_manager.findfont("DejaVu Sans Mono")
        self.font = ImageFont.truetype(found, POINTS)
        self.width, self.height = round(self.font.getlength("m")), round(1.25 * POINTS)

    def show(self, milliseconds: int) -> None:
        """Add a picture of the screen, or show the last one for longer if it is the same."""
        picture = Image.new("RGB", (self.width * (COLUMNS + 2), self.height * (LINES + 1)), BACKGROUND)
        draw = ImageDraw.Draw(picture)
        for row in range(LINES):
            for column in range(COLUMNS):
                cell = self.screen.buffer[row][column]
                if cell.data != " ":
                    at = (self.width * (column + 1), self.height * row + self.height // 2)
                    draw.text(at, cell.data, COLORS.get(cell.fg, COLORS["default"]), font=self.font)
        if self.pictures and picture.tobytes() == self.pictures[-1].tobytes():
            self.times[-1] = min(self.times[-1] + milliseconds, LAST)
        else:
            self.pictures.append(picture)
            self.times.append(milliseconds)

    def run(self, command: str, until: bytes | None, folder: Path) -> None:
        """Type a command, run it, and add its pictures."""
        self.stream.feed(b"$ ")
        for letter in command:
            self.stream.feed(letter.encode())
            if letter == " ":
                self.show(4 * TYPED)
        self.stream.feed(b"\r\n")
        self.show(4 * TYPED)
        process, terminal = pty.fork()
        if not process:
            os.chdir(folder)
            signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell ignores it for commands in the background
            os.environ |= {"COLUMNS": str(COLUMNS), "LINES": str(LINES), "TERM": "xterm"}
            os.execvp("sh", ["sh", "-c", f"stty cols {COLUMNS} rows {LINES}; exec {command}"])
        said, due, ends = b"", time.monotonic() + STEP, until is None
        while True:
            if select.select([terminal], [], [], STEP)[0]:
                try:
                    output = os.read(terminal, 65536)
                except OSError:  # the command has ended
                    break
                if not output:
                    break
                self.stream.feed(output)
                said += output
            if time.monotonic() >= due:
                self.show(LONGEST)
                due = time.monotonic() + STEP
            if until and until in said:
                self.show(LAST)
                os.kill(process, signal.SIGINT)
                until = None
        if os.waitpid(process, 0)[1] and ends:
            sys.exit(f"{command} failed:\n{said.decode(errors='replace')[-2000:]}")
        self.show(LAST)

    def save(self, path: Path) -> None:
        """Write all pictures."""
        few = [picture.quantize(16, dither=Image.Dither.NONE) for picture in self.pictures]
        few[0].save(path, save_all=True, append_images=few[1:], duration=self.times, loop=0, optimize=True)


def main() -> None:
    """Record the commands on a folder of photos."""
    photos = Path(sys.argv[1]).resolve()
    recording = Recording()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "photos").symlink_to(photos)
        for command, until in COMMANDS:
            recording.run(command, until, Path(folder))
    recording.save(OUT)


if __name__ == "__main__":
    main()
