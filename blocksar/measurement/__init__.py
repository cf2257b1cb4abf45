"""Measurements of the image: point-target responses, coherence with a reference image, and quality limits."""
