from .page import Page as Page
from .page import Shape as Shape
from .page import Text as Text
from .prints import print_boards as print_boards
from .prints import print_patches as print_patches
from .sheet import PageFormat as PageFormat
from .sheet import Sheet as Sheet
from .sheet import board_sheet as board_sheet
from .sheet import parse_page_format as parse_page_format
from .sheet import patch_sheet as patch_sheet
from .sheet import save_sheet as save_sheet
from .sidecar import correct_sidecars as correct_sidecars

__all__: list[str]
