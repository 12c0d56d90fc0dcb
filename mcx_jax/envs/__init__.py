"""The simulated world: arm dynamics, inverse kinematics, actuation delay, vessels, observation."""
