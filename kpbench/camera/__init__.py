"""The physics of a camera, from the scene to the file, one pure function per step.

The geometric steps map points: the bow of the paper and the gain of the ink (:mod:`kpbench.camera.paper`), and the
motion during the exposure (:mod:`kpbench.camera.shutter`). The lens is part of :mod:`kpbench.geometry`.
"""
