"""The detectors that ship with kpbench; :func:`kpbench.detectors.load_detector` knows them by name."""
