"""Limits and periods of the paper's robot (section "Actions"); see :class:`.robot_settings.RobotSettings`."""

# Actions (paper, section "Actions").
MIN_LINEAR_VELOCITY = -0.2
"""w_minv, m/s."""


MAX_LINEAR_VELOCITY = 0.6
"""w_maxv, m/s."""


MAX_TURN_DEG_PER_S = 90.0
"""w_maxomega, degrees/s."""


DEAD_BAND_DEG_PER_S = 15.0
"""Desired angular velocities below this are taken as 0, degrees/s."""


MAX_LINEAR_ACCELERATION = 1.5
"""w_accv, m/s^2."""


MAX_TURN_ACCELERATION_DEG_PER_S2 = 120.0
"""w_accomega, degrees/s^2."""


MOTOR_PERIOD_S = 0.02
"""Control period of the motor controller, Delta t."""


MEAN_PERIOD_S = 0.14
"""Mean control period of an agent. An episode's is 6, 7 or 8 motor periods: 0.12, 0.14 or 0.16 s."""
