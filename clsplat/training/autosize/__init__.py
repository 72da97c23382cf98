"""The number of Gaussians, chosen from the photos (docs/size.md): the rule, the search, the explanation.

Belongs here: what ``--size auto`` decides. Does not belong here: where Gaussians are added
(`clsplat.training.densify`) and what removing one costs (`clsplat.pruning`).
"""
