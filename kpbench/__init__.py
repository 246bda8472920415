"""kpbench: design, print, synthesise, find and score keypoint patches.

The public names stand in ``__init__.pyi`` and are imported when they are first used: ``import kpbench`` loads neither
torch, h5py, onnxruntime, OpenCV nor pandas.

Examples
--------
>>> import kpbench
>>> [patch.name for patch in kpbench.shipped_patches()]
['checker', 'trefoil', 'wheel', 'mushroom']
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
