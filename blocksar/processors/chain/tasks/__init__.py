"""Units of work of a chain: recovery, gates, blocks, patches and their mosaic."""
