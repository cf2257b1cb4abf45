"""Raw echoes of satellites: what their formats have in common."""
