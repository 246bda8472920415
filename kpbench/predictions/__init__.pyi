from .coco import CocoDataset as CocoDataset
from .coco import open_coco as open_coco
from .files import read_predictions as read_predictions
from .files import write_predictions as write_predictions

__all__: list[str]
