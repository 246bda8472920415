"""Frames, homographies, a camera, exact outlines and the area that outlines cover.

Conventions of the whole package
--------------------------------
* Image frame: px, x right, y down. The centre of the top-left pixel is (0, 0), as in OpenCV.
* Patch frame: the patch is the unit disc, u right, v down. Angles grow from +u towards +v.
* Board frame: mm, x right, y down, z away from the viewer. The origin is the board's centre.
* Camera frame: x right, y down, z forward.

Examples
--------
>>> from kpbench.geometry import circle, flatten, rasterise
>>> disc = flatten(circle(10.0, 10.0, 5.0), tolerance=1e-4)
>>> (coverage,) = rasterise([disc], [(0, 0, 21, 21)])
>>> round(float(coverage.sum() / 5.0**2), 5)
3.14159
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
