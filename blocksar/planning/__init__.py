"""From a collection's metadata to everything that focusing needs, with a prediction of the image's quality."""
