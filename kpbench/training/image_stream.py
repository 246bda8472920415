"""Images that a training makes while it runs: an iterable dataset of PyTorch, without files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kpbench.dataset.config import DatasetConfig
from kpbench.dataset.generation import describe_config
from kpbench.dataset.padding import pad_sample
from kpbench.dataset.shard import canonical_json
from kpbench.errors import DataError
from kpbench.synth.synthetic import SynthConfig
from kpbench.workers import survive_forks, use_threads

try:
    import torch
    import torch.distributed as dist
    from torch.utils.data import IterableDataset, get_worker_info
except ImportError as error:
    raise ImportError(f"kpbench.stream needs PyTorch: pip install 'kpbench[train]' ({error})") from None

Arrays = dict[str, NDArray[Any]]
"""A sample, or a batch of samples, by the names that :func:`kpbench.dataset.pad_sample` lists."""


class ImageStream(IterableDataset[Arrays]):
    """The images of a configuration, made when they are asked for. :func:`kpbench.stream` makes it.

    A ``torch.utils.data.DataLoader`` takes the stream with any number of forked or spawned workers.

    Attributes
    ----------
    config : DatasetConfig
    batch_size : int or None
        Images per batch of one rank; None if the elements of the stream are single samples.
    rank, ranks : int
        Number of this process among the processes that train together, from 0, and the number of these processes.

    Examples
    --------
    >>> import kpbench
    >>> images = kpbench.stream(kpbench.SynthConfig(n=100, size_px=(96, 96)), batch_size=8)
    >>> len(images), images.epoch
    (13, 0)
    """

    def __init__(self, config: DatasetConfig, batch_size: int | None, rank: int, ranks: int) -> None:
        for name, value, least, most in (
            ("batch_size", batch_size, 1, 10**9),
            ("ranks", ranks, 1, 10**9),
            ("rank", rank, 0, ranks - 1),
        ):
            if value is not None and not least <= value <= most:
                raise DataError(f"`{name}` is {value}, expected a number from {least} to {most}")
        self.config, self.batch_size, self.rank, self.ranks = config, batch_size, rank, ranks
        self._digest = hashlib.sha256(canonical_json(describe_config(config)).encode()).hexdigest()
        survive_forks()
        # workers that stay between two passes share this memory, so that they see `set_epoch`
        self._start = torch.zeros(2, dtype=torch.int64)
        self._start.share_memory_()  # type: ignore[no-untyped-call]
        self._steps = 0

    @property
    def epoch(self) -> int:
        """The epoch that the next pass shows, from 0."""
        return int(self._start[0])

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch that the next pass shows. Call this before every pass of a training of several epochs.

        Epoch e of a :class:`kpbench.SynthConfig` of n images shows the images e·n to (e + 1)·n - 1, so no image is
        shown twice. Every epoch of another configuration shows the same images. A pass begins with the first image of
        its epoch. Only the epoch that :meth:`load_state_dict` has set goes on where the state says.
        """
        if epoch != self.epoch:
            self._start[0], self._start[1], self._steps = epoch, 0, 0

    def __len__(self) -> int:
        """Return the number of elements of the next pass on this rank."""
        images, per_step = self.config.n - int(self._start[1]), self.ranks * (self.batch_size or 1)
        return -(-images // per_step) if self.ranks == 1 else images // per_step

    def __iter__(self) -> Iterator[Arrays]:
        worker = get_worker_info()
        number, workers = (worker.id, worker.num_workers) if worker else (0, 1)
        if worker:
            use_threads(1)
        epoch, start = self._start.tolist()
        first, self._steps = self._steps, 0
        for step in range(number + first * workers, len(self), workers):
            batch = self._make_step(epoch, start, step)
            self._steps = (step - number) // workers + 1
            yield batch
        self._steps = 0

    def _make_step(self, epoch: int, start: int, step: int) -> Arrays:
        """Make the element that this rank gets in a step of a pass that begins with image ``start`` of an epoch."""
        size = self.batch_size or 1
        first = start + (step * self.ranks + self.rank) * size
        shift = epoch * self.config.n if isinstance(self.config, SynthConfig) else 0
        made = [self.config.make(shift + n)[0] for n in range(first, min(first + size, self.config.n))]
        rows = self.config.most_keypoints
        samples = [pad_sample(sample.image, sample.keypoints, sample.image_id, rows) for sample in made]
        if self.batch_size is None:
            return samples[0]
        batch = {name: np.stack([sample[name] for sample in samples]) for name in samples[0]}
        next_image = min(start + (step + 1) * self.ranks * size, self.config.n)
        return {**batch, "epoch": np.array(epoch), "next_image": np.array(next_image)}

    def state_dict(self, after: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Return the state from which a stream of the same configuration goes on.

        Parameters
        ----------
        after : mapping, optional
            The last batch that was used. Workers make batches in advance, so only a batch tells how far a training is.
            None: go on after the last element that this process has made. torchdata's ``StatefulDataLoader`` calls the
            method in this way, in each of its workers.

        Returns
        -------
        dict
            Numbers and a text, which JSON can hold. The state that a batch tells is the same on every rank, and suits
            any batch size, number of ranks and number of workers.

        Raises
        ------
        DataError
            If ``after`` is no batch of a stream with a ``batch_size``.
        """
        if after is not None:
            if "next_image" not in after:
                raise DataError("`after` has no next_image, expected a batch of a stream that was given `batch_size`")
            return self._state(int(after["epoch"]), int(after["next_image"]), 0)
        epoch, start = self._start.tolist()
        if get_worker_info():
            return self._state(epoch, start, self._steps)
        done = min(start + self._steps * self.ranks * (self.batch_size or 1), self.config.n)
        return self._state(epoch, done, 0)

    def _state(self, epoch: int, image: int, steps: int) -> dict[str, Any]:
        return {"config": self._digest, "epoch": epoch, "image": image, "steps": steps}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next pass go on from a state.

        Raises
        ------
        DataError
            If the state is not that of a stream, or belongs to another configuration, background files or software.
        """
        names = ("epoch", "image", "steps")
        if not all(type(state.get(name)) is int and state[name] >= 0 for name in names):
            raise DataError(f"`state` is {dict(state)!r}, expected a state from `state_dict`")
        if state.get("config") != self._digest:
            raise DataError(
                "`state` was made by a stream of another configuration, of other background files or of other software"
            )
        self._start[0], self._start[1], self._steps = (state[name] for name in names)


def stream(
    config: DatasetConfig, batch_size: int | None = None, *, rank: int | None = None, ranks: int | None = None
) -> ImageStream:
    """Stream labelled images into a training. They are made when they are asked for, and no file is written.

    Image i is the image i of the dataset that :func:`kpbench.generate` makes. Give the batch size to the stream, and
    ``batch_size=None`` to the ``DataLoader``. Then the batches and their order do not depend on the number of workers.

    Parameters
    ----------
    config : DatasetConfig
        Configuration such as :class:`kpbench.SynthConfig`. Its ``n`` is the number of images per epoch.
    batch_size : int, optional
        Images per batch of this rank. The elements of the stream are then batches: the arrays of
        :func:`kpbench.dataset.pad_sample` with a first axis for the images, ``epoch``, and ``next_image``, which
        :meth:`ImageStream.state_dict` reads. Every column of keypoints has ``config.most_keypoints`` rows. None: the
        elements are single samples, which a ``DataLoader`` collates. Its workers then share out samples, so which
        samples meet in a batch depends on the number of workers.
    rank, ranks : int, optional
        Number of this process among those that train together, and their number. Default: those of the process group of
        ``torch.distributed``, else of ``torchrun``, else 0 and 1. Step s of all ranks together shows ranks · batch_size
        successive images. Images that do not fill a batch on every rank are left out.

    Returns
    -------
    ImageStream

    Raises
    ------
    DataError
        If a value is out of its range.
    ImportError
        If torch is not installed.

    Examples
    --------
    >>> import kpbench
    >>> from torch.utils.data import DataLoader
    >>> images = kpbench.stream(kpbench.SynthConfig(n=6, size_px=(96, 96)), batch_size=4)
    >>> for batch in DataLoader(images, batch_size=None):
    ...     print(tuple(batch["image"].shape), tuple(batch["xy"].shape))
    (4, 1, 96, 96) (4, 10, 2)
    (2, 1, 96, 96) (2, 10, 2)
    """
    if rank is None and ranks is None:
        if dist.is_available() and dist.is_initialized():
            rank, ranks = dist.get_rank(), dist.get_world_size()
        else:
            rank, ranks = int(os.environ.get("RANK", 0)), int(os.environ.get("WORLD_SIZE", 1))
    if rank is None or ranks is None:
        raise DataError("`rank` and `ranks` belong together, only one is given")
    return ImageStream(config, batch_size, rank, ranks)
