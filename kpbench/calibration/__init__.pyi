from .camera_solution import Calibration as Calibration
from .camera_solution import calibrate as calibrate
from .marks import BoardPoints as BoardPoints
from .marks import MarkFinder as MarkFinder
from .photos import Photo as Photo
from .shape import PrintShape as PrintShape

__all__: list[str]
