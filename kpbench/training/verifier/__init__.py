"""Training of the three small networks of :mod:`kpbench.detectors.verification`.

:mod:`~kpbench.training.verifier.ellipse` trains the ellipse network, :mod:`~kpbench.training.verifier.judges` the two
judges. Both take synthetic datasets (``kpbench synth``), which must be made over photographs that are free for
training.
"""
