"""The protocol of a configuration from which a dataset is made."""

from __future__ import annotations

from typing import Any, Protocol

from kpbench.dataset.shard import Sample


class DatasetConfig(Protocol):
    """A configuration of a dataset. The configuration and the background files determine every image.

    A configuration is picklable and hashable. kpbench has two: :class:`kpbench.SynthConfig` and
    :class:`kpbench.SuiteConfig`.

    Examples
    --------
    >>> from kpbench import SynthConfig
    >>> from kpbench.dataset import DatasetConfig
    >>> config: DatasetConfig = SynthConfig(n=20_000)
    >>> config.n, config.shard_size
    (20000, 500)
    """

    @property
    def n(self) -> int:
        """Number of images."""
        ...

    @property
    def shard_size(self) -> int:
        """Images per shard."""
        ...

    @property
    def image_bytes(self) -> int:
        """Expected size of one image on disk, bytes."""
        ...

    @property
    def most_keypoints(self) -> int:
        """Largest number of true keypoints that an image can have."""
        ...

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration as it is written into the dataset, without any path."""
        ...

    def scene_id(self, index: int) -> int:
        """Return the ID of an image's base scene. Shards are made scene by scene, to reuse the scene's background."""
        ...

    def make(self, index: int) -> tuple[Sample, tuple[str, ...]]:
        """Make one image. Return the sample, and the paths of the background files that could not be decoded."""
        ...

    def __hash__(self) -> int: ...
