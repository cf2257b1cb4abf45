"""Two runs on one grid: interferogram, coherence, amplitude ratio and change, as a store and as pictures."""
