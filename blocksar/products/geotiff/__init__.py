"""The image of a run as a cloud-optimised GeoTIFF."""
