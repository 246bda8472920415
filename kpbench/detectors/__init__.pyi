from .heads import Decoding as Decoding
from .heads import decode as decode
from .heads import keypoint_probability as keypoint_probability
from .hypotheses import VerifiedCandidates as VerifiedCandidates
from .interface import DETECTORS as DETECTORS
from .interface import Detector as Detector
from .interface import LoadedDetector as LoadedDetector
from .interface import load_detector as load_detector
from .prediction import PredictionRun as PredictionRun
from .prediction import predict as predict
from .prediction import predict_images as predict_images
from .prediction import record_cost as record_cost
from .sources import has_other_designs as has_other_designs
from .sources import open_source as open_source
from .superpoint import SmallSuperPointDetector as SmallSuperPointDetector
from .superpoint import SuperPointDetector as SuperPointDetector
from .suppression import suppress as suppress
from .template import TemplateDetector as TemplateDetector
from .verification import verify_candidates as verify_candidates

__all__: list[str]
