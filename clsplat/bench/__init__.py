"""Measurements that users can repeat on their own device: `clsplat bench`.

Belongs here: timing, comparisons of settings and of methods, their results, and the charts of both. Does not belong
here: what is measured (rendering, training, metrics), and measurements that need files the package does not contain
(``tests``).
"""
