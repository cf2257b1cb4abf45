"""Parts that processors share: profiles, sums over pulses, patterns, noise, interference, layers of a terrain."""
