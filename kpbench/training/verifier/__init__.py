"""Training of the three small networks of :mod:`kpbench.detectors.verification`.

:mod:`~kpbench.training.verifier.ellipse` trains the ellipse network. :mod:`~kpbench.training.verifier.judges` trains
the two judges. Both modules take synthetic datasets (``kpbench synth``). The backgrounds of these datasets must be
photographs that may be used for training.
"""
