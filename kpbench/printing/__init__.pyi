from .dxf import to_dxf as to_dxf
from .page import Page as Page
from .page import Shape as Shape
from .page import Text as Text
from .page_format import PageFormat as PageFormat
from .page_format import parse_page_format as parse_page_format
from .pdf import to_pdf as to_pdf
from .png import px_per_mm as px_per_mm
from .png import to_png as to_png
from .prints import print_boards as print_boards
from .prints import print_patches as print_patches
from .prints import save_sheet as save_sheet
from .sheet import Sheet as Sheet
from .sheet import board_sheet as board_sheet
from .sheet import patch_sheet as patch_sheet
from .sidecar import correct_sidecars as correct_sidecars
from .svg import to_svg as to_svg
from .targets import write_targets as write_targets

__all__: list[str]
