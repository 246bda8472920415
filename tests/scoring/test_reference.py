"""The reference implementation in the docstring of ``score`` gives what ``score`` gives."""

import doctest

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from kpbench.scoring.metrics import PAPER_METRICS
from kpbench.scoring.scores import score
from kpbench.types import KEYPOINT_DTYPE, Detections, Truth


def reference_metrics():
    """Run the docstring's code as it stands there, up to the function's definition."""
    namespace = {}
    for part in doctest.DocTestParser().get_examples(score.__doc__):
        if part.source.startswith(("from", "def")):
            exec(part.source, namespace)
    return namespace["reference_metrics"]


REFERENCE = reference_metrics()
IDENTITY = st.integers(0, 2)
RADIUS = st.sampled_from([5.0, 10.0, 20.0])
COUNTS = st.lists(st.tuples(st.integers(0, 3), st.integers(0, 4)), min_size=1, max_size=3)


@st.composite
def cases(draw):
    """Images with keypoints in each other's reach, at random places, so that no two assignments are worth the same.

    A detection may be repeated with another identity, as a detector does that will not decide.
    """
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    images = []
    for keypoints, found in draw(COUNTS):
        true = [(*rng.uniform(0, 12, 2), draw(RADIUS), draw(IDENTITY)) for _ in range(keypoints)]
        rows = [(*rng.uniform(0, 12, 2), rng.random(), draw(IDENTITY)) for _ in range(found)]
        if found and draw(st.booleans()):
            rows[-1] = (*rows[0][:3], draw(IDENTITY))
        images.append((true, rows))
    return images


def tables(images):
    rows = [row for true, _ in images for row in true]
    keypoints = np.zeros(len(rows), KEYPOINT_DTYPE)
    for name, column in zip(("x", "y", "radius_major", "patch_id"), zip(*rows, strict=True), strict=False):
        keypoints[name] = column
    ids = np.arange(len(images))
    offsets = np.concatenate([[0], np.cumsum([len(true) for true, _ in images])]).astype(np.int64)
    truth = Truth(ids, offsets, keypoints, np.full(len(ids), ""), np.full(len(ids), np.nan), ids)
    found = [np.array(rows).reshape(-1, 4) for _, rows in images]
    return truth, [Detections(rows[:, :2], rows[:, 2], rows[:, 3].astype(int)) for rows in found]


@given(cases(), st.sampled_from([0.1, 0.5, 1.0]))
@example([([], [])], 0.1)
@example([([(0.0, 0.0, 10.0, 1)], [(1.0, 0.0, 0.5, 1), (1.0, 0.0, 0.5, 2)])], 0.1)  # at ε, with two identities
@settings(max_examples=150)
def test_the_docstrings_code_gives_the_same_metrics(images, eps):
    scores = score(*tables(images), eps=eps, resamples=0)
    assert {name: scores[name] for name in PAPER_METRICS} == REFERENCE(images, eps)
