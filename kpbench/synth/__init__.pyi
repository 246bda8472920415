from .degraded import DegradeConfig as DegradeConfig
from .suite import SuiteConfig as SuiteConfig
from .suite_file import Condition as Condition
from .suite_file import Suite as Suite
from .suite_file import load_suite as load_suite
from .suite_file import shipped_suites as shipped_suites
from .suite_view import View as View
from .synthetic import SynthConfig as SynthConfig
from .user_pipeline import load_augmentation as load_augmentation

__all__: list[str]
