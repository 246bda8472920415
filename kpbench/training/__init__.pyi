from .batches import Batch as Batch
from .batches import SampleConfig as SampleConfig
from .batches import load_photos as load_photos
from .batches import make_batch as make_batch
from .checkpoint import TrainingState as TrainingState
from .checkpoint import start_state as start_state
from .export import Exported as Exported
from .export import export_onnx as export_onnx
from .image_stream import ImageStream as ImageStream
from .loop import TrainOptions as TrainOptions
from .loop import train as train
from .network import SuperPoint as SuperPoint
from .pipeline import make_weights as make_weights
from .quantise import export_int8 as export_int8
from .recipe import LossConfig as LossConfig
from .recipe import NetworkConfig as NetworkConfig
from .recipe import Phase as Phase
from .recipe import Recipe as Recipe
from .recipe import VerifierConfig as VerifierConfig
from .recipe import VerifierSet as VerifierSet
from .recipe import load_recipe as load_recipe
from .step import train_step as train_step
from .verifier.ellipse import train_ellipse as train_ellipse
from .verifier.judges import train_judges as train_judges

__all__: list[str]
