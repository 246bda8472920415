from .card import Histogram as Histogram
from .card import dataset_facts as dataset_facts
from .card import dataset_histograms as dataset_histograms
from .card import draw_overview as draw_overview
from .card import draw_rungs as draw_rungs
from .config import DatasetConfig as DatasetConfig
from .drawing import draw_detections as draw_detections
from .drawing import draw_keypoints as draw_keypoints
from .drawing import enlarge_for_drawing as enlarge_for_drawing
from .export import export_dataset as export_dataset
from .folder import Dataset as Dataset
from .folder import ShardEntry as ShardEntry
from .folder import open_dataset as open_dataset
from .generation import GenerationResult as GenerationResult
from .generation import generate as generate
from .generation import generate_part as generate_part
from .generation import merge as merge
from .labelled import open_labelled as open_labelled
from .padding import pad_sample as pad_sample
from .shard import Sample as Sample
from .splits import split_scenes as split_scenes

__all__: list[str]
