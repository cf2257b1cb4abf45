"""Products of a finished run: SICD, SIDD, GeoTIFF, STAC, pictures, the report page; xarray: accessor, engine."""
