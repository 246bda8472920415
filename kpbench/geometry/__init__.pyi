from .camera import Camera as Camera
from .camera_file import read_camera as read_camera
from .camera_file import write_camera as write_camera
from .coverage import bounding_box as bounding_box
from .coverage import rasterise as rasterise
from .homography import project as project
from .homography import project_discs as project_discs
from .outline import Arc as Arc
from .outline import Line as Line
from .outline import circle as circle
from .outline import flatten as flatten
from .outline import move as move
from .outline import rectangle as rectangle

__all__: list[str]
