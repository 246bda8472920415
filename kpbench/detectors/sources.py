"""Sources that a detector can run over: datasets, and images without truth."""

from __future__ import annotations

from pathlib import Path

from kpbench.dataset.folder import MANIFEST, Dataset, open_dataset
from kpbench.images import ImageSource, open_images, refuse_same_folder
from kpbench.patches.design import shipped_patches


def open_source(source: str | Path, overlay: Path | None = None) -> Dataset | ImageSource:
    """Open a dataset, an image, a folder of images, a video, or a camera.

    Parameters
    ----------
    source : str or Path
        Path, or ``camera:0`` for the first camera.
    overlay : Path, optional
        Folder or file that detections will be drawn into. Images below this folder are left out of the source.

    Returns
    -------
    Dataset or ImageSource
        For :func:`kpbench.predict`.

    Raises
    ------
    DataError
        If the source cannot be opened, or ``overlay`` is the folder of the source's images.

    Examples
    --------
    >>> import kpbench
    >>> len(kpbench.detectors.open_source("kpbench-data"))
    6
    """
    if overlay is not None:
        refuse_same_folder(source, overlay)
    if (Path(source) / MANIFEST).exists() or any(Path(source).glob("shard-*.h5")):
        return open_dataset(source)
    return open_images(str(source), exclude=overlay)


def has_other_designs(source: Dataset | ImageSource) -> bool:
    """Return whether a source is a dataset whose designs differ from the shipped designs.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.detectors.has_other_designs(kpbench.open_dataset("kpbench-data"))
    False
    """
    if isinstance(source, ImageSource):
        return False
    shown = source.config.get("patches")
    return shown is not None and shown != [patch.to_dict() for patch in shipped_patches()]
