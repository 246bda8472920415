from .films import TrackRun as TrackRun
from .films import draw_pose as draw_pose
from .films import track_images as track_images
from .motion_filter import PoseFilter as PoseFilter
from .scores import TrackGroup as TrackGroup
from .scores import TrackScores as TrackScores
from .scores import score_poses as score_poses
from .second_look import find_missed as find_missed
from .second_look import look_twice as look_twice
from .tracker import TrackedPose as TrackedPose
from .tracker import Tracker as Tracker

__all__: list[str]
