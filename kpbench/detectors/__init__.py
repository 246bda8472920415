"""The detectors that ship with kpbench; :func:`kpbench.detect.load_detector` knows them by name."""

SHIPPED = {
    "template": "kpbench.detectors.template:TemplateDetector",
}
"""Name → ``MODULE:ATTR``."""
