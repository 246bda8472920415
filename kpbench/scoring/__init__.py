"""Score detections against true keypoints: matching, metrics, intervals, groups, comparison, pose of the board.

Arrays go in and numbers come out; nothing in this room reads a file.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
