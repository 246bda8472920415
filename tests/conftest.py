"""Shared by all tests."""

from hypothesis import settings

settings.register_profile("kpbench", deadline=None)  # how fast a busy machine is proves nothing
settings.load_profile("kpbench")
