"""The price of removing a Gaussian, and the smallest version of a trained scene.

Belongs here: prices, orders of removal, merging, harmonics in fewer numbers, and the search for a version within
limits. Does not belong here: training, which uses the prices, and the formats that a version is stored in.
"""
