"""The collection: axes of the samples, track, beam, ground region and image grid."""
