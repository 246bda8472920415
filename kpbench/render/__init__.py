"""Rendering of clean images of patches in front of a background, with the true keypoints.

``render_scene`` draws single patches in random poses. ``render_board`` draws one board in front of a camera. Both
functions blend each pixel by the exact fraction of its area that the patch or the board covers.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
