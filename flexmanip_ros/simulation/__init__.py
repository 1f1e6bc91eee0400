"""The simulated arm: integration, sensors, noise, excitation, injected faults."""
