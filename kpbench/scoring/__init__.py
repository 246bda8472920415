"""Score detections against true keypoints: matching, metrics, intervals, groups, comparison, pose of the board.

The functions take arrays and return numbers. They read no files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
