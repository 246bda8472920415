from .background import PhotoFolder as PhotoFolder
from .background import procedural_background as procedural_background
from .board_projection import Pose as Pose
from .board_projection import pose_board as pose_board
from .board_view import Appearance as Appearance
from .board_view import board_keypoints as board_keypoints
from .board_view import render_board as render_board
from .detail import paint_detail as paint_detail
from .lookalikes import draw_lookalikes as draw_lookalikes
from .placement import Limits as Limits
from .placement import Placement as Placement
from .placement import random_placements as random_placements
from .placement import random_poses as random_poses
from .scene import Rendering as Rendering
from .scene import measure_contrast as measure_contrast
from .scene import render_scene as render_scene

__all__: list[str]
