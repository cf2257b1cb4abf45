"""Needs of an image by any processor: division of the work, seconds, memory, disk; and ambiguities."""
