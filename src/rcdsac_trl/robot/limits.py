"""Limits and motor period of the paper's robot (section "Actions"); see :class:`.robot_settings.RobotSettings`."""

import math

# Actions (paper, section "Actions").
MIN_LINEAR_VELOCITY = -0.2
"""w_minv, m/s."""


MAX_LINEAR_VELOCITY = 0.6
"""w_maxv, m/s."""


MAX_ANGULAR_VELOCITY = math.radians(90.0)
"""w_maxomega, rad/s."""


DEAD_BAND = math.radians(15.0)
"""Desired angular velocities below this are taken as 0, rad/s."""


MAX_LINEAR_ACCELERATION = 1.5
"""w_accv, m/s^2."""


MAX_ANGULAR_ACCELERATION = math.radians(120.0)
"""w_accomega, rad/s^2."""


MOTOR_PERIOD_S = 0.02
"""Control period of the motor controller, Delta t."""
