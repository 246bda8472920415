"""A clean image becomes a worse one; no effect knows what a patch is."""
