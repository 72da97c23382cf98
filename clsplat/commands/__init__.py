"""The commands of the program `clsplat`: a dataclass each, from which tyro makes flags and help."""
