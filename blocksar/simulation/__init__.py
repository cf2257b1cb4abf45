"""Scene files to phase histories, raw echoes and CPHD files."""
