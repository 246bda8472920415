"""Every error that kpbench raises on purpose.

::

    KpbenchError            one line for the user: file, place, what was expected
    ├── DesignError         a patch, board or page that cannot be (TOML, geometry, paper size)
    ├── DataError           a dataset, shard, image folder or weights file that cannot be used
    ├── PredictionsError    a predictions file that cannot be read, or that fits no dataset
    └── GateFailed          the scores are fine to read, but a ``--min`` gate was not met

The command line prints the message and exits with 1; a library user catches ``KpbenchError``.
"""

from __future__ import annotations


class KpbenchError(Exception):
    """Base of all errors that kpbench raises on purpose."""


class DesignError(KpbenchError):
    """A patch, board or page that cannot be."""


class DataError(KpbenchError):
    """A dataset, shard, image folder or weights file that cannot be used."""


class PredictionsError(KpbenchError):
    """A predictions file that cannot be read, or that fits no dataset."""


class GateFailed(KpbenchError):
    """A ``--min METRIC=VALUE`` gate was not met."""
