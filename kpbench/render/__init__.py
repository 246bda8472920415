"""Patches before a background: a clean image and its truth."""
