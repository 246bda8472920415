from .camera import Camera as Camera
from .coverage import rasterise as rasterise
from .homography import project as project
from .homography import project_discs as project_discs

__all__: list[str]
