"""Measures of designs: how well they are located, told apart, and told from natural images."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
