"""The simulated arm: dynamics, linearization, capture, sensors, torques."""
