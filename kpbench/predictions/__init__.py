"""Predictions files in and out."""
