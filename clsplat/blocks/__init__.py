"""Training in blocks: a scene is cut into parts, each of which fits one device, and joined again.

Belongs here: the cut of a scene (`partition`), the photos of each part (`survey`), the numbers of a run (`plan`), a
part as a pure function of files (`jobs`, `block`), the whole run (`whole`), and its jobs on a cluster (`cluster`).
Does not belong here: iterations and edits of Gaussians (`clsplat.training`), and messages (`clsplat.commands`).
"""
