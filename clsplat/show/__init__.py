"""Presentation of results: the live viewer, web pages of scenes and evaluations, pictures, and camera paths.

Belongs here: everything that turns results into pictures, pages and camera paths. Does not belong here: rendering
(`clsplat.render`), metrics (`clsplat.metrics`, `clsplat.evaluate`), and the charts of benchmarks (`clsplat.bench`).
"""
