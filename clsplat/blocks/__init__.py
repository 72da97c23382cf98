"""Training in blocks: a scene is cut into blocks, each of which fits one device, and joined again.

Belongs here: the cut of a scene (`partition`), the photos of each block (`survey`), the numbers of a run (`plan`), a
block as a pure function of files (`jobs`, `block`) and what it reads of a scene (`parts`, `sight`), the whole run
(`whole`), its jobs on a cluster (`cluster`) and their data there (`transport`).
Does not belong here: iterations and edits of Gaussians (`clsplat.training`), and messages (`clsplat.commands`).
"""
