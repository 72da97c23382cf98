"""Commands of the program `clsplat`: one dataclass each, from which tyro makes flags and help texts.

Belongs here: flags, checks of arguments, and what a command prints. Does not belong here: the work itself, which is a
function of another package, and the commands of `clsplat bench` (`clsplat.bench`).
"""
