"""Frames, homographies, a camera, exact outlines and the area that they cover; *the* pixel convention.

x right, y down, float64 px. The centre of the top-left pixel is (0, 0), as in OpenCV.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
