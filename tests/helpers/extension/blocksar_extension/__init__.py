"""Parts of blocksar that are not its own."""
