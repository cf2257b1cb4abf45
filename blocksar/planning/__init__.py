"""Plans of how to focus a collection, from its metadata alone, with the predicted quality of the image."""
