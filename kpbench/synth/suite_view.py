"""What an image of a suite shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from kpbench.degrade.effects import Effect
from kpbench.geometry.camera import Camera
from kpbench.patches.board import BoardLike
from kpbench.render.board_exposure import ExposedBoard
from kpbench.render.board_projection import Pose
from kpbench.render.board_view import Appearance


@dataclass(frozen=True)
class View:
    """Everything that one image of a suite shows, except the background, before anything is painted.

    Attributes
    ----------
    condition : str
    rung : float
    scene_id : int
        The base scene.
    board : Board or TagBoard
    pose : Pose
    appearance : Appearance
    effects : list of dict
        Records of the effects, see :func:`kpbench.degrade.draw_effect`.
    keypoints : ndarray of shape (n,), KEYPOINT_DTYPE
        The truth before occlusion; ``contrast`` is nan.
    camera : Camera
        Lens and size of the image.
    exposed : ExposedBoard or None
        The board as the camera exposes it. None without a preset.
    taken : dict or None
        What the camera drew, see :meth:`kpbench.camera.CameraPreset.draw`. None without a preset.
    frame : dict or None
        Record of the frame, see :func:`kpbench.synth.film.film_record`. None if the suite has no films.

    Examples
    --------
    >>> from kpbench import SuiteConfig, load_suite
    >>> view = SuiteConfig(load_suite("paper-v1"), images=2).view(0)
    >>> view.condition, view.rung, len(view.keypoints)
    ('scale', 0.5, 6)
    """

    condition: str
    rung: float
    scene_id: int
    board: BoardLike
    pose: Pose
    appearance: Appearance
    effects: list[Effect]
    keypoints: NDArray[Any]
    camera: Camera
    exposed: ExposedBoard | None = None
    taken: Effect | None = None
    frame: Effect | None = None
