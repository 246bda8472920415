from .matching import BoardMatch as BoardMatch
from .matching import find_board as find_board
from .pose import BoardPose as BoardPose
from .pose import estimate_pose as estimate_pose
from .pose import pose_distance as pose_distance

__all__: list[str]
