"""The signal processing: lines, steps, chains, recovery, geometric correction and back-projection."""
