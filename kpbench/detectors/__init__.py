"""Detectors: the interface, the shipped detectors, and functions that run detectors over datasets and images.

A detector is a function of an image, or an object with a method ``detect``; both return
:class:`kpbench.Detections`. :func:`load_detector` loads a detector by name.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
