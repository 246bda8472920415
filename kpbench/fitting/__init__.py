"""Poses of designs, found and fitted on the pixels of an image.

A pose is affine: ``x_px = xy + A @ u`` maps a point ``u`` of the patch frame to the image. In the patch frame, the disc
has the radius 1. :func:`fit` needs a starting pose that is right to about a tenth of the radius.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
