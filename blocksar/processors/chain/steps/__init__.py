"""Steps of a chain, and what they do to samples and to time-frequency lines."""
