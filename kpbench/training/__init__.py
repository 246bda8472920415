"""Training of the weights: of the detector's network by a recipe, and of the networks of its verification.

Everything but :func:`load_recipe` and the configurations needs ``pip install 'kpbench[train]'``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
