"""``python -m clsplat``: the command line."""

from clsplat.cli import main

main()
