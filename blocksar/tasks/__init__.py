"""Units of work that know no processor: samples, chunks of an image, layers, pyramids, tracks."""
