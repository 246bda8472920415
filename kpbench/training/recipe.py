"""Training recipes: TOML files that are read into a :class:`Recipe`. This module does not need torch."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from kpbench.errors import DataError
from kpbench.files import shipped_folder
from kpbench.text import did_you_mean
from kpbench.toml import TomlTable, name_source, read_toml
from kpbench.training.batches import SampleConfig

MOST_CHANNELS, MOST_LAYERS, MOST_IDS = 4096, 64, 256
"""Limits of a network, so that a damaged file cannot ask for all memory."""


@dataclass(frozen=True)
class NetworkConfig:
    """Sizes of the network. The defaults are the sizes of SuperPoint.

    Attributes
    ----------
    widths : tuple of 4 int
        Number of channels of each encoder stage. The stages work at strides 1, 2, 4 and 8.
    depths : tuple of 4 int
        Number of 3x3 convolutions in each stage.
    down : str
        How each of the first three stages halves the image: "max" (max-pooling after the stage) or "stride" (the
        last convolution of the stage has stride 2).
    head_width, descriptor_width : int
        Number of channels of the hidden layer of each head, and number of channels of the descriptor.
    norm : str
        Position of BatchNorm: "before" the activation (the export folds BatchNorm into the convolution) or "after"
        the activation (as in the published SuperPoint weights).
    ids : int
        Number of designs that the ID head tells apart, besides "no patch".

    Examples
    --------
    >>> from kpbench.training import NetworkConfig
    >>> NetworkConfig(head_width=128).widths
    (64, 64, 128, 128)
    """

    widths: tuple[int, int, int, int] = (64, 64, 128, 128)
    depths: tuple[int, int, int, int] = (2, 2, 2, 2)
    down: str = "max"
    head_width: int = 256
    descriptor_width: int = 256
    norm: str = "before"
    ids: int = 4

    def __post_init__(self) -> None:
        if len(self.widths) != 4 or len(self.depths) != 4 or min(*self.widths, *self.depths) < 1:
            raise DataError(
                f"network: widths {self.widths} and depths {self.depths}, expected four positive numbers each"
            )
        channels, layers = max(*self.widths, self.head_width, self.descriptor_width), max(self.depths)
        if channels > MOST_CHANNELS or layers > MOST_LAYERS or not 1 <= self.ids <= MOST_IDS:
            raise DataError(
                f"network: {channels} channels, {layers} layers in a stage and {self.ids} ids, expected at most "
                f"{MOST_CHANNELS}, {MOST_LAYERS} and {MOST_IDS}"
            )
        if self.down not in ("max", "stride") or self.norm not in ("before", "after"):
            raise DataError(
                f"network: down is {self.down!r} and norm {self.norm!r}, expected max or stride, and before or after"
            )


@dataclass(frozen=True)
class LossConfig:
    """The loss that a training minimises: detector loss + ``identity_weight`` · identity loss.

    Attributes
    ----------
    place : str
        Target of the detector head. "pixel": the pixel nearest to the keypoint, as in SuperPoint. "split": the four
        pixels around the keypoint, with bilinear weights; the four pixels may belong to different cells.
    positive_weight : float
        Weight of a cell with a keypoint, relative to a cell without a keypoint.
    focal : float
        Exponent of the focal factor (Lin et al., *Focal loss for dense object detection*, ICCV 2017). The focal factor
        lowers the weight of well-predicted cells in the detector loss. 0: no focal factor.
    identity : str
        "entropy": cross-entropy over designs and "no patch", at cells within 8 px of a keypoint and at cells more than
        16 px from all keypoints. "hinge": SuperPoint's descriptor loss over all pairs of cells. One cell gives its
        descriptor, the other cell gives its one-hot class. Pairs of one class are positive, all other pairs are
        negative.
    identity_weight : float
        Weight of the identity loss.
    lambda_d, positive_margin, negative_margin : float
        Parameters of the hinge loss, as in Table 1 of the paper: weight of the positive pairs, and the two margins.

    Examples
    --------
    >>> from kpbench.training import LossConfig
    >>> LossConfig(place="pixel", identity="hinge").positive_margin
    0.9
    """

    place: str = "split"
    positive_weight: float = 1.0
    focal: float = 0.0
    identity: str = "entropy"
    identity_weight: float = 0.2
    lambda_d: float = 640 * 480 / 5
    positive_margin: float = 0.9
    negative_margin: float = 0.2


@dataclass(frozen=True)
class Phase:
    """A part of a training. Each phase trains its own choice of layers, at its own severity.

    Attributes
    ----------
    samples : int
        Number of samples in the phase.
    trains : str
        Layers that are trained: "all" or "attached" (the attached layers alone).
    severity : (float, float)
        Severity of the degradations at the first and at the last sample of the phase, from 0 to 1; see
        :func:`kpbench.training.make_batch`.

    Examples
    --------
    >>> from kpbench.training import Phase
    >>> Phase(1000, severity=(0.0, 1.0)).trains
    'all'
    """

    samples: int
    trains: str = "all"
    severity: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class VerifierSet:
    """A synthetic dataset that trains the networks of the verification.

    Attributes
    ----------
    images : int
    seed : int
        Seed of the dataset, see :class:`kpbench.SynthConfig`.
    deteriorate : str
        "none", "paper" or "ladder".
    camera : str
        Name or file of a camera, see :func:`kpbench.camera.load_camera_preset`; "none" for a linear world.
    radius_px : tuple of 2 float, or ()
        Smallest and largest radius of the patches, px. (): the default radii.
    distractors : int
        Largest number of look-alikes per image.
    size : tuple of 2 int
        Width and height, px.

    Examples
    --------
    >>> from kpbench.training import VerifierSet
    >>> VerifierSet(images=1000, camera="phone").deteriorate
    'paper'
    """

    images: int
    seed: int = 0
    deteriorate: str = "paper"
    camera: str = "none"
    radius_px: tuple[float, ...] = ()
    distractors: int = 0
    size: tuple[int, int] = (640, 480)


@dataclass(frozen=True)
class VerifierConfig:
    """How the networks of the verification are trained after the detector's network.

    Attributes
    ----------
    sets : tuple of VerifierSet
        Images to train on.
    test : VerifierSet
        Images that calibrate log odds, place the threshold and measure reports, over photographs that train nothing.
    ellipse_epochs, judge_epochs : int
        Passes over the places, and over the hypotheses.
    first_sets : int
        Number of ``sets``, from the first one on, whose judges only correct poses for the judges that are kept.
    alarms_per_image : float
        Largest number of false alarms per image of ``test`` at the score from which on a detector reports.

    Examples
    --------
    >>> from kpbench.training import load_recipe
    >>> load_recipe("paper").verifier is None
    True
    """

    sets: tuple[VerifierSet, ...]
    test: VerifierSet
    ellipse_epochs: int = 6
    judge_epochs: int = 10
    first_sets: int = 1
    alarms_per_image: float = 0.04

    def __post_init__(self) -> None:
        if not self.sets or min(s.images for s in (*self.sets, self.test)) < 1:
            raise DataError("verifier: expected at least one set, and at least one image in each set")
        if not 1 <= self.first_sets <= len(self.sets):
            raise DataError(f"verifier.first_sets is {self.first_sets}, expected a number from 1 to {len(self.sets)}")
        if any(len(s.radius_px) not in (0, 2) for s in (*self.sets, self.test)):
            raise DataError("verifier: radius_px needs two numbers, the smallest and the largest radius")


@dataclass(frozen=True)
class Recipe:
    """A training recipe. Recipe, photographs, designs and initial weights together determine a training.

    Attributes
    ----------
    name : str
    phases : tuple of Phase
    seed : int
    network : NetworkConfig
    samples : SampleConfig
    loss : LossConfig
    batch : int
        Number of samples per step, summed over all processes.
    optimizer : str
        "adam" (weight decay as an L2 penalty, as in the paper) or "adamw".
    lr, weight_decay : float
        Learning rate and weight decay.
    warmup : int
        Number of samples during which the learning rate rises from 0 to its full value.
    schedule : str
        "step" (the learning rate is multiplied by ``decay`` at each entry of ``decay_at``) or "cosine" (the learning
        rate falls from ``lr`` to ``decay`` · ``lr``, along half a cosine).
    decay : float
        Factor of the learning rate, see ``schedule``.
    decay_at : tuple of int
        Numbers of samples after which the learning rate falls, see ``schedule``.
    ema : float
        Decay per step of the running mean of the weights; the running mean is validated and exported.
    precision : str
        "fp32" or "bf16" (autocast). "bf16" is twice as fast on a GPU or on a processor with AMX or AVX512-BF16. "bf16"
        is far slower on other processors.
    compile : bool
        Whether ``torch.compile`` is used.
    verifier : VerifierConfig, optional
        None: only the detector's network is trained.

    Raises
    ------
    DataError
        If a value is out of its range.

    Examples
    --------
    >>> from kpbench.training import load_recipe
    >>> recipe = load_recipe("paper")
    >>> [phase.samples for phase in recipe.phases]
    [300000, 300000, 2400000]
    >>> recipe.rate(0), recipe.steps
    (0.0005, 375000)
    """

    name: str
    phases: tuple[Phase, ...]
    seed: int = 0
    network: NetworkConfig = field(default_factory=NetworkConfig)
    samples: SampleConfig = field(default_factory=SampleConfig)
    loss: LossConfig = field(default_factory=LossConfig)
    batch: int = 64
    optimizer: str = "adamw"
    lr: float = 1e-3
    weight_decay: float = 1e-4
    warmup: int = 0
    schedule: str = "cosine"
    decay: float = 0.05
    decay_at: tuple[int, ...] = ()
    ema: float = 0.999
    precision: str = "fp32"
    compile: bool = False
    verifier: VerifierConfig | None = None

    def __post_init__(self) -> None:
        if not self.phases or min(p.samples for p in self.phases) < 1 or self.batch < 1:
            raise DataError("phases and batch: expected at least one phase, of at least one sample, and a batch from 1")
        if not self.steps:
            raise DataError(f"phases: together, they have fewer samples than one batch, expected at least {self.batch}")

    @property
    def steps(self) -> int:
        """Number of steps of the optimizer."""
        return sum(p.samples for p in self.phases) // self.batch

    def phase(self, step: int) -> tuple[Phase, float]:
        """Return the phase at a step, and the severity of the degradations at this step."""
        at = step * self.batch
        for phase in self.phases[:-1]:
            if at < phase.samples:
                break
            at -= phase.samples
        else:
            phase = self.phases[-1]
        low, high = phase.severity
        return phase, low + (high - low) * min(at / phase.samples, 1.0)

    def rate(self, step: int) -> float:
        """Return the learning rate at a step."""
        at = step * self.batch
        warm = min((at + self.batch) / self.warmup, 1.0) if self.warmup else 1.0
        if self.schedule == "step":
            return self.lr * warm * self.decay ** sum(at >= a for a in self.decay_at)
        done = min(step / max(self.steps, 1), 1.0)
        return self.lr * warm * (self.decay + (1 - self.decay) * 0.5 * (1 + math.cos(math.pi * done)))


T = TypeVar("T")
CHOICES = {  # key → its allowed values
    "place": ("pixel", "split"),
    "identity": ("entropy", "hinge"),
    "trains": ("all", "attached"),
    "optimizer": ("adam", "adamw"),
    "schedule": ("step", "cosine"),
    "precision": ("bf16", "fp32"),
    "kind": ("crops", "scenes"),
    "deteriorate": ("none", "paper", "ladder"),
}


def shipped_recipes() -> dict[str, Path]:
    """Return the files of the shipped recipes; each key is the file name without its suffix."""
    return {path.stem: path for path in sorted(shipped_folder("configs").glob("*.toml"))}


def load_recipe(name: str | Path) -> Recipe:
    """Read a training recipe, given a key of :func:`shipped_recipes` or the path of a TOML file.

    Raises
    ------
    DataError
        If no shipped recipe has this name, or if the file cannot be read, is no TOML, or has an unknown key or a wrong
        value.

    Examples
    --------
    >>> from kpbench.training import load_recipe
    >>> load_recipe("reference").name
    'superpoint-small'
    """
    shipped = shipped_recipes()
    path = shipped.get(str(name), Path(name))
    if str(name) not in shipped and path.suffix != ".toml":
        raise DataError(
            f"there is no recipe {str(name)!r}, only: {', '.join(shipped)}, or a .toml file of your own"
            f"{did_you_mean(str(name), shipped)}"
        )
    return parse_recipe(read_toml(path, DataError), str(path))


def parse_recipe(content: Mapping[str, Any], source: str) -> Recipe:
    """Return the recipe that a table describes; ``source`` names the file in error messages."""
    with name_source(source, DataError):
        return _parse(Recipe, TomlTable(content, get_type_hints(Recipe), DataError))


def _parse(cls: type[T], table: TomlTable) -> T:
    """Return the dataclass that a table describes. Each value must have the type of its field."""
    values = {key: _parse_field(table, key, kind) for key, kind in get_type_hints(cls).items() if key in table}
    missing = [f.name for f in fields(cls) if not _has_default(f) and f.name not in values]  # type: ignore[arg-type]
    if missing:
        raise DataError(f"{table.place or 'the recipe'} lacks {' and '.join(missing)}")
    return cls(**values)


def _has_default(field: Field[Any]) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


def _parse_field(table: TomlTable, key: str, kind: Any) -> Any:
    if get_origin(kind) is UnionType:
        kind = get_args(kind)[0]
    if isinstance(kind, type) and is_dataclass(kind):
        return _parse(kind, table.table(key, get_type_hints(kind)))
    if get_origin(kind) is tuple:
        element, last = get_args(kind)[0], get_args(kind)[-1]
        if isinstance(element, type) and is_dataclass(element):
            return tuple(_parse(element, entry) for entry in table.tables(key, get_type_hints(element)))
        return table.numbers(key, 0, count=None if last is Ellipsis else len(get_args(kind)), whole=element is int)
    if kind is bool:
        return table.flag(key)
    if key == "name":
        return table.name()
    if kind is str:
        return table.choice(key, CHOICES[key]) if key in CHOICES else table.text(key)
    return table.whole_number(key, 0) if kind is int else table.number(key, 0)
