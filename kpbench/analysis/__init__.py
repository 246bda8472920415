"""Measures of designs (localisation, identity, look-alikes in natural images), and the search for the best designs.

Examples
--------
>>> import kpbench
>>> from kpbench.analysis import PolarGrid, correlation_and_distance
>>> patches = kpbench.shipped_patches()
>>> grid = PolarGrid.of(patches)
>>> correlation, distance = correlation_and_distance(grid, grid.inks(patches))
>>> distance.shape
(4, 4)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
