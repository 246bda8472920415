"""Boards in images: which detection is which point of a board, and the board's pose."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
