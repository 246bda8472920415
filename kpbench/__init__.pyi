from .benchmark import bench as bench
from .benchmark import write_suite_reports as write_suite_reports
from .dataset.export import export_dataset as export_dataset
from .dataset.folder import Dataset as Dataset
from .dataset.folder import open_dataset as open_dataset
from .dataset.generation import generate as generate
from .dataset.generation import merge as merge
from .detectors.interface import Detector as Detector
from .detectors.interface import load_detector as load_detector
from .detectors.prediction import predict as predict
from .errors import KpbenchError as KpbenchError
from .evaluate import compare_files as compare_files
from .evaluate import score_file as score_file
from .fitting.design_fit import fit as fit
from .patches.board import Board as Board
from .patches.board import grid_board as grid_board
from .patches.board import hexagon_board as hexagon_board
from .patches.board import load_board as load_board
from .patches.design import Patch as Patch
from .patches.design import load_patches as load_patches
from .patches.design import shipped_patches as shipped_patches
from .predictions.files import read_predictions as read_predictions
from .predictions.files import write_predictions as write_predictions
from .render.scene import render_scene as render_scene
from .report.report import write_report as write_report
from .scoring.comparison import compare as compare
from .scoring.scores import Scores as Scores
from .scoring.scores import score as score
from .synth.suite import SuiteConfig as SuiteConfig
from .synth.suite_file import load_suite as load_suite
from .synth.synthetic import SynthConfig as SynthConfig
from .types import KEYPOINT_DTYPE as KEYPOINT_DTYPE
from .types import Detections as Detections
from .types import Predictions as Predictions
from .types import Truth as Truth

__version__: str
__all__: list[str]
