"""``kpbench.stream`` and datasets in a DataLoader: the same samples whatever the workers, the ranks and the stops."""

import hashlib
import json

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader, Subset

import kpbench
from kpbench.dataset import pad_sample
from kpbench.errors import DataError

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")
CONFIG = kpbench.SynthConfig(n=10, size_px=(64, 64))


def loader(images, workers=0, method=None):
    return DataLoader(images, batch_size=None, num_workers=workers, multiprocessing_context=method)


def digest(batches):
    """SHA-256 over every array of every batch, in order."""
    whole = hashlib.sha256()
    for batch in batches:
        for name in sorted(batch):
            whole.update(f"{name} {tuple(batch[name].shape)}".encode() + batch[name].numpy().tobytes())
    return whole.hexdigest()


def train(workers=0, method=None, stop=None):
    """Digest of the batches of two epochs; ``stop`` leaves the process after so many batches, and resumes."""
    images, seen = kpbench.stream(CONFIG, batch_size=3), []
    for epoch in range(2):
        images.set_epoch(epoch)
        for batch in loader(images, workers, method):
            seen.append(batch)
            if len(seen) == stop:
                state = json.dumps(images.state_dict(after=batch))
                break
        if len(seen) == stop:
            break
    if stop:
        images = kpbench.stream(CONFIG, batch_size=3)
        images.load_state_dict(json.loads(state))
        for epoch in range(images.epoch, 2):
            images.set_epoch(epoch)
            seen += loader(images, workers, method)
    return digest(seen)


@pytest.fixture(scope="module")
def undisturbed():
    return train()


@pytest.mark.parametrize("stop", [None, 2, 4, 6])
@pytest.mark.parametrize("workers", [0, 2, 4])
def test_a_training_sees_the_same_batches_whatever_the_workers_and_the_stops(undisturbed, workers, stop):
    assert train(workers, "fork" if workers else None, stop) == undisturbed


def test_spawned_workers_make_the_same_batches():
    images = kpbench.stream(CONFIG, batch_size=5)
    assert digest(loader(images, 2, "spawn")) == digest(loader(images))


def test_workers_that_stay_see_the_next_epoch():
    images = kpbench.stream(CONFIG, batch_size=5)
    kept = DataLoader(images, batch_size=None, num_workers=2, multiprocessing_context="fork", persistent_workers=True)
    for epoch in range(2):
        images.set_epoch(epoch)
        shown = [int(n) for batch in kept for n in batch["image_id"]]
        assert shown == list(range(10 * epoch, 10 * epoch + 10))


def test_ranks_share_out_the_images_of_each_step():
    ranks = [kpbench.stream(CONFIG, batch_size=2, rank=rank, ranks=2) for rank in range(2)]
    steps = list(zip(*(list(loader(rank, 2, "fork")) for rank in ranks), strict=True))
    assert [[b["image_id"].tolist() for b in step] for step in steps] == [[[0, 1], [2, 3]], [[4, 5], [6, 7]]]
    states = [rank.state_dict(after=batch) for rank, batch in zip(ranks, steps[0], strict=True)]
    assert states[0] == states[1]
    alone = kpbench.stream(CONFIG, batch_size=3)  # another number of ranks, another batch size
    alone.load_state_dict(states[0])
    assert [batch["image_id"].tolist() for batch in loader(alone)] == [[4, 5, 6], [7, 8, 9]]


def test_the_state_of_each_worker_goes_on(monkeypatch):
    """As torchdata's StatefulDataLoader uses it: each worker saves and loads a state of its own."""
    from kpbench.training import image_stream

    class Worker:
        id, num_workers = 1, 2

    monkeypatch.setattr(image_stream, "get_worker_info", lambda: Worker)
    monkeypatch.setattr(image_stream, "use_threads", lambda count: None)
    images, again = (kpbench.stream(CONFIG, batch_size=2) for _ in range(2))
    passing = iter(images)
    assert next(passing)["image_id"].tolist() == [2, 3]
    again.load_state_dict(images.state_dict())
    assert [batch["image_id"].tolist() for batch in again] == [[6, 7]]


def test_the_samples_are_those_of_the_dataset(tmp_path):
    dataset = kpbench.generate(CONFIG, tmp_path / "set", workers=1).dataset
    for n, sample in enumerate(kpbench.stream(CONFIG)):
        image, keypoints = dataset[n]
        expected = pad_sample(image, keypoints, n, CONFIG.most_keypoints)
        assert sample.keys() == expected.keys()
        assert all(np.array_equal(sample[name], expected[name], equal_nan=name != "image") for name in expected)


@pytest.mark.parametrize(("workers", "method"), [(0, None), (2, "fork")])
def test_a_loader_takes_a_dataset_as_it_is(dataset, workers, method):
    given = {"batch_size": 4, "num_workers": workers, "multiprocessing_context": method}
    batches = list(DataLoader(dataset, **given))
    assert [tuple(batch["image"].shape) for batch in batches] == [(4, 1, 240, 320), (2, 1, 240, 320)]
    for n in range(6):
        batch, row = batches[n // 4], n % 4
        image, keypoints = dataset[n]
        assert torch.equal(batch["image"][row, 0], torch.tensor(image))
        count = int((batch["patch_id"][row] >= 0).sum())
        assert batch["patch_id"][row, :count].tolist() == keypoints["patch_id"].tolist()
        assert np.allclose(batch["xy"][row, :count, 0], keypoints["x"], atol=1e-4)
    (part,) = DataLoader(Subset(dataset, [5, 1]), **given)
    assert part["image_id"].tolist() == [5, 1]


def test_impossible_values_are_told():
    for given, problem in (
        ({"batch_size": 0}, "`batch_size` is 0"),
        ({"rank": 2, "ranks": 2}, "`rank` is 2, expected a number from 0 to 1"),
        ({"rank": 1}, "belong together"),
    ):
        with pytest.raises(DataError, match=problem):
            kpbench.stream(CONFIG, **given)
    images, other = kpbench.stream(CONFIG), kpbench.stream(kpbench.SynthConfig(n=11, size_px=(64, 64)))
    with pytest.raises(DataError, match="another configuration"):
        images.load_state_dict(other.state_dict())
    with pytest.raises(DataError, match="expected a state"):
        images.load_state_dict({"epoch": 1})
    with pytest.raises(DataError, match="next_image"):
        images.state_dict(after=next(iter(images)))
