"""Things to look at: the live viewer, the web page of a scene, the page of an evaluation, camera paths.

Belongs here: what turns results into pictures, pages and paths. Does not belong here: rendering (`clsplat.render`),
metrics (`clsplat.metrics`, `clsplat.evaluate`), and the charts of benchmarks (`clsplat.bench`).
"""
