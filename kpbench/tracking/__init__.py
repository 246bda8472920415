"""Boards in films: predict, fit in windows, verify, and look at the whole image when the board is lost."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
