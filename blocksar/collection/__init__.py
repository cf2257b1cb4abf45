"""What was collected and where: the samples' axes, the track, the beam, the ground and the image's grid."""
