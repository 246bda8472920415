"""Rendering of patches in front of a background: a clean image and its truth.

There are two kinds of scene: single patches in random poses (``render_scene``), and one board in front of a camera
(``render_board``). Both functions paint by exact area coverage.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
