"""Training of the detector's network by a recipe, and of the three networks that verify the detector's candidates.

Recipes and training samples need no further package. Training and export need ``pip install 'kpbench[train]'``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
