from .board import Board as Board
from .board import BoardKeypoint as BoardKeypoint
from .board import BoardLike as BoardLike
from .board import BoardPoint as BoardPoint
from .board import grid_board as grid_board
from .board import hexagon_board as hexagon_board
from .board_file import find_patch as find_patch
from .board_file import load_board as load_board
from .board_file import load_boards as load_boards
from .design import Patch as Patch
from .design import SemiCircle as SemiCircle
from .design import load_patches as load_patches
from .design import shipped_patches as shipped_patches
from .field import field_board as field_board
from .field import field_boards as field_boards
from .field import shipped_field as shipped_field
from .lattice import field_distance as field_distance
from .reference import ReferenceMark as ReferenceMark
from .reference_boards import truth_board as truth_board
from .reference_boards import with_reference as with_reference
from .symmetry import board_turns_deg as board_turns_deg
from .symmetry import pose_problem as pose_problem
from .tag_boards import TagBoard as TagBoard
from .tag_boards import TagCorner as TagCorner
from .tag_boards import tag_board as tag_board

__all__: list[str]
