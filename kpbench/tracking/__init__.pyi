
from .motion_filter import PoseFilter as PoseFilter
from .tracker import TrackedPose as TrackedPose
from .tracker import Tracker as Tracker

__all__: list[str]
