"""Read and write predictions files in every format. Read COCO annotations as truth."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
