"""One arm on a moving base: model, kinematics, dynamics, servos, delay."""
