"""Shared by all tests."""

import pytest
from hypothesis import settings

settings.register_profile("kpbench", deadline=None)  # how fast a busy machine is proves nothing
settings.load_profile("kpbench")


@pytest.fixture
def here(tmp_path, monkeypatch):
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path
