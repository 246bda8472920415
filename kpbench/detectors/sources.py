"""Sources that a detector can run over: datasets, and images without truth."""

from __future__ import annotations

import glob
import os
from collections.abc import Sequence
from pathlib import Path

from kpbench.dataset.folder import MANIFEST, Dataset
from kpbench.dataset.labelled import is_labelled, open_labelled
from kpbench.errors import DataError
from kpbench.files import IMAGE_SUFFIXES, image_files
from kpbench.images import ImageSource, open_images, read_files, refuse_same_folder
from kpbench.patches.design import shipped_patches
from kpbench.predictions.coco import CocoDataset


def open_source(*sources: str | Path, overlay: Path | None = None) -> Dataset | CocoDataset | ImageSource:
    """Open labelled images, images without labels, folders of images, a video, or a camera.

    Parameters
    ----------
    sources : str or Path
        Path, ``camera:0`` for the first camera, or a pattern such as ``photos/**/*.png``. The path may be labelled
        images, as for :func:`kpbench.dataset.open_labelled`. Several sources are images and folders of images; an image
        that is there twice is taken once.
    overlay : Path, optional
        Folder or file that detections will be drawn into. Images below this folder are left out of the source.

    Returns
    -------
    Dataset, CocoDataset or ImageSource
        For :func:`kpbench.predict`.

    Raises
    ------
    DataError
        If a source cannot be opened, a pattern fits no file, several sources are not images and folders, or ``overlay``
        is the folder of the images.

    Examples
    --------
    >>> import kpbench
    >>> len(kpbench.detectors.open_source("kpbench-data"))
    6
    """
    given = [path for source in sources for path in _expand(str(source))]
    if overlay is not None:
        for path in given:
            refuse_same_folder(path, overlay)
    if len(given) > 1:
        return _open_several(given, overlay)
    [source] = given
    if is_labelled(source):
        return open_labelled(source)
    return open_images(source, exclude=overlay)


def _expand(source: str) -> list[str]:
    """Return the paths that a pattern fits, sorted; or the source itself if it is no pattern, or a path that exists."""
    if os.path.lexists(source) or not glob.has_magic(source):
        return [source]
    found = sorted(glob.glob(source, recursive=True))
    if not found:
        raise DataError(f"{source}: the pattern fits no file")
    return found


def _open_several(sources: Sequence[str], exclude: Path | None) -> ImageSource:
    """Open images and folders of images as one source, in the order of the sources."""
    paths = dict[Path, None]()
    for source in sources:
        path = Path(source)
        if path.is_dir() and not (path / MANIFEST).exists():
            paths |= dict.fromkeys(path / name for name in image_files(path, exclude))
        elif path.suffix.lower() in IMAGE_SUFFIXES and path.is_file():
            paths[path] = None
        else:
            raise DataError(f"{source}: expected an image or a folder of images, as one of {len(sources)} sources")
    if not paths:
        raise DataError(f"{sources[0]} and {len(sources) - 1} more sources: no image in these folders")
    if len({path.is_absolute() for path in paths}) > 1 or any(".." in path.parts for path in paths):
        paths = dict.fromkeys(Path(os.path.abspath(path)) for path in paths)
    folder = os.path.commonpath([path.parent for path in paths])
    names = tuple(path.relative_to(folder).as_posix() for path in paths)
    problems: dict[str, str] = {}
    images = read_files(Path(folder), names, problems)
    return ImageSource(images, len(names), problems=problems, names=names, folder=folder)


def has_other_designs(source: Dataset | CocoDataset | ImageSource) -> bool:
    """Return whether a source is a dataset whose designs differ from the shipped designs.

    Examples
    --------
    >>> import kpbench
    >>> kpbench.detectors.has_other_designs(kpbench.open_dataset("kpbench-data"))
    False
    """
    if not isinstance(source, Dataset):
        return False
    shown = source.config.get("patches")
    return (
        shown is not None
        and any("semicircles" in p for p in shown)
        and shown != [patch.to_dict() for patch in shipped_patches()]
    )
