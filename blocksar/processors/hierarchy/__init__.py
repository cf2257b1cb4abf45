"""Hierarchical back-projection: small parts of an image from data that hold no more than these."""
