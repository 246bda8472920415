from .datasets import DatasetDifference as DatasetDifference
from .datasets import check_drift as check_drift
from .datasets import diff as diff
from .distributions import DistributionShift as DistributionShift
from .distributions import compute_shift as compute_shift
from .distributions import exchange_scenes as exchange_scenes
from .images import PixelChanges as PixelChanges
from .images import TruthChanges as TruthChanges
from .summary import summarise_difference as summarise_difference

__all__: list[str]
