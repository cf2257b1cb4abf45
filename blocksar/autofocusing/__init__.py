"""The error of the track, estimated from the samples; see README.md."""
