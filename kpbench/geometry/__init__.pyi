from .camera import Camera as Camera
from .coverage import coverage as coverage
from .homography import project as project
from .homography import projected_discs as projected_discs

__all__: list[str]
