"""Products of a finished run: SICD, GeoTIFF, pictures, the report page and the xarray accessor."""
