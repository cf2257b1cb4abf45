"""Pictures: mosaic, responses, panels and quick looks."""
