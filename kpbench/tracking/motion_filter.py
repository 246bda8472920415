"""A Kalman filter of a pose with constant velocity.

State: rotation R and translation t of the board, angular velocity w (rad/s) and velocity v (mm/s), all in the camera
frame. The errors are (ω, δ, w, v): the true state is ``exp([ω]×) R``, ``t + δ`` and so on. Between frames, random
accelerations change the velocities (Y. Bar-Shalom et al., *Estimation with Applications to Tracking and Navigation*,
2001, section 6.3.2: piecewise constant white acceleration).
"""

from __future__ import annotations

import numpy as np

from kpbench.boards.pose import BoardPose, exp_rotation, rotation_vector

TURN_ACCELERATION, ACCELERATION = 15.0, 5000.0
"""Standard deviations of the accelerations, rad/s² and mm/s²: those of a board in a hand that moves fast."""
START_TURN, START_SPEED = 3.0, 1500.0
"""Standard deviations of the velocities at the start, rad/s and mm/s."""
OUTLIER = 60.0
"""A measured pose that is further from the prediction, in squared standard deviations, starts the filter anew. The 99.9
% limit of six degrees of freedom is 22; hands jerk."""


class PoseFilter:
    """The filtered pose of a board.

    Parameters
    ----------
    pose : BoardPose
        The first measured pose.
    time_s : float
        Its time.

    Examples
    --------
    >>> import numpy as np
    >>> from kpbench.boards import BoardPose
    >>> from kpbench.tracking import PoseFilter
    >>> def pose_at(x_mm):
    ...     return BoardPose(np.eye(3), np.array([x_mm, 0.0, 500.0]), 1e-4 * np.eye(6), 0.1, 6)
    >>> motion = PoseFilter(pose_at(0.0), 0.0)
    >>> for n in range(1, 20):
    ...     motion.predict(n / 30)
    ...     motion.update(pose_at(3.0 * n))
    >>> motion.predict(20 / 30)
    >>> round(float(motion.pose.translation_mm[0]))
    60
    """

    def __init__(self, pose: BoardPose, time_s: float) -> None:
        self.time_s = time_s
        self._start(pose)

    def _start(self, pose: BoardPose) -> None:
        self.rotation, self.translation_mm, self.velocity = pose.rotation, pose.translation_mm, np.zeros(6)
        self.covariance = np.diag([*(0.0,) * 6, *(START_TURN**2,) * 3, *(START_SPEED**2,) * 3])
        self.covariance[:6, :6] = pose.covariance
        self.updates = 1

    def predict(self, time_s: float) -> None:
        """Move the state to a later time."""
        dt, self.time_s = max(time_s - self.time_s, 0.0), max(time_s, self.time_s)
        self.rotation = exp_rotation(dt * self.velocity[None, :3])[0] @ self.rotation
        self.translation_mm = self.translation_mm + dt * self.velocity[3:]
        F = np.eye(12)
        F[:6, 6:] = dt * np.eye(6)
        variance = np.repeat([TURN_ACCELERATION**2, ACCELERATION**2], 3)
        noise = np.zeros((12, 12))
        for (row, column), factor in (((0, 0), dt**4 / 4), ((0, 6), dt**3 / 2), ((6, 0), dt**3 / 2), ((6, 6), dt**2)):
            noise[row : row + 6, column : column + 6] = np.diag(factor * variance)
        self.covariance = F @ self.covariance @ F.T + noise

    def update(self, pose: BoardPose) -> None:
        """Take a measured pose of the current time. A pose that is far from the prediction starts the filter anew."""
        turn = rotation_vector(pose.rotation @ self.rotation.T)
        error = np.append(turn, pose.translation_mm - self.translation_mm)
        S = self.covariance[:6, :6] + pose.covariance
        if float(error @ np.linalg.solve(S, error)) > OUTLIER:
            self._start(pose)
            return
        gain = np.linalg.solve(S, self.covariance[:6]).T
        change = gain @ error
        self.rotation = exp_rotation(change[None, :3])[0] @ self.rotation
        self.translation_mm = self.translation_mm + change[3:6]
        self.velocity = self.velocity + change[6:]
        covariance = self.covariance - gain @ self.covariance[:6]
        self.covariance = (covariance + covariance.T) / 2
        self.updates += 1

    @property
    def pose(self) -> BoardPose:
        """The filtered pose. Its ``reprojection_rms_px`` is nan, and it is made of no points of this frame alone."""
        return BoardPose(self.rotation, self.translation_mm, self.covariance[:6, :6], np.nan, 0)
