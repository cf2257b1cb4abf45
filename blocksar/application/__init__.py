"""The work of commands: jobs, stages of a run, several collections and channels, tracks, chips, targets."""
