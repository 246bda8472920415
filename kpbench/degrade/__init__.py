"""Degrade images: the effects, the ladder of their levels, and the user's own files.

No effect depends on the designs. An effect that aims at patches takes the discs of the patches: x, y and radius in px.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
