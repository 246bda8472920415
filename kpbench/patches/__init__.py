"""Designs of patches, boards that carry patches at known places, and boards of tags for comparison.

Examples
--------
>>> from kpbench.patches import hexagon_board, shipped_patches
>>> board = hexagon_board(shipped_patches()[0], side_mm=200.0)
>>> len(board.keypoints), board.keypoints[0].diameter_mm
(6, 32.0)
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
