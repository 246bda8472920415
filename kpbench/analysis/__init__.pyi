from .localisation import Bound as Bound
from .measures import Analysis as Analysis
from .measures import DesignReport as DesignReport
from .pipeline import AnalysedPatches as AnalysedPatches
from .pipeline import analyse_patches as analyse_patches
from .pipeline import background_windows as background_windows

__all__: list[str]
