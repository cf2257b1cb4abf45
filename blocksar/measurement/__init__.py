"""What the image tells: point responses, coherence with a reference, and the bar for both."""
