"""Geometry: frames, homographies, outlines and exact coverage; *the* pixel convention."""
