from .drawing import draw_board as draw_board
from .images import PoseRecord as PoseRecord
from .images import find_boards as find_boards
from .images import locate_boards as locate_boards
from .matching import BoardMatch as BoardMatch
from .matching import find_board as find_board
from .pose import BoardPose as BoardPose
from .pose import estimate_pose as estimate_pose
from .pose import pose_distance as pose_distance
from .pose_files import POSE_COLUMNS as POSE_COLUMNS
from .pose_files import read_poses as read_poses
from .pose_files import write_poses as write_poses

__all__: list[str]
