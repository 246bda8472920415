"""Run detectors over benchmark suites and datasets, and report their scores."""
