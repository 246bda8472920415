"""Shared by all tests."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # PyTorch: the processes of pytest-xdist share the cores

import pytest
from hypothesis import settings

from kpbench import SynthConfig, generate

settings.register_profile("kpbench", deadline=None)  # how fast a busy machine is proves nothing
settings.load_profile("kpbench")


@pytest.fixture(scope="session")
def dataset(tmp_path_factory):
    """Six images without deteriorations, in two shards; no test may change it."""
    config = SynthConfig(6, size_px=(320, 240), shard_size=4, deteriorate="none")
    return generate(config, tmp_path_factory.mktemp("made") / "set", workers=1).dataset


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
