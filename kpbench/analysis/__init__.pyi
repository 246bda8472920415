from .analyse import AnalysisRun as AnalysisRun
from .analyse import analyse_patches as analyse_patches
from .bias import BIAS_EFFECTS as BIAS_EFFECTS
from .bias import camera_bias as camera_bias
from .cell_images import PolarGrid as PolarGrid
from .cell_images import attitudes as attitudes
from .family import FAMILY_GRID as FAMILY_GRID
from .family import code_of as code_of
from .family import enumerate_family as enumerate_family
from .family import inks_of as inks_of
from .identity import correlation_and_distance as correlation_and_distance
from .localisation import Bound as Bound
from .localisation import basin as basin
from .localisation import design_bound as design_bound
from .localisation import point_bound as point_bound
from .measures import SIZES_PX as SIZES_PX
from .measures import Analysis as Analysis
from .measures import DesignMeasures as DesignMeasures
from .measures import pixels_needed as pixels_needed
from .natural_images import background_windows as background_windows
from .natural_images import natural_response as natural_response
from .natural_images import sample_windows as sample_windows
from .search import SearchResult as SearchResult
from .search import best_sets as best_sets
from .search import search_designs as search_designs

__all__: list[str]
