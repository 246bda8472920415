from .camera_solution import Calibration as Calibration
from .camera_solution import calibrate as calibrate
from .label_dataset import LabelResult as LabelResult
from .label_dataset import label as label
from .marks import BoardPoints as BoardPoints
from .marks import MarkFinder as MarkFinder
from .photos import Photo as Photo
from .print_check import PrintCheck as PrintCheck
from .print_check import check_print as check_print
from .shape import PrintShape as PrintShape

__all__: list[str]
