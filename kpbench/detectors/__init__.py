"""The detectors that ship with kpbench; :func:`kpbench.detect.load_detector` knows them by name."""
