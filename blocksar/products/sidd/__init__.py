"""The image of a run as a SIDD file (Sensor Independent Derived Data, NGA.STND.0025, version 3.0), through sarkit.

Pixels are detected, averaged over looks if asked for, and remapped: 8 bits, in which 1 .. 255 are dB over a range, and
0 is not covered (`pixels`, as of a GeoTIFF of whole numbers). DataRemapping has the amplitude that each stands for, of
which 65535 is the upper end of the range.

On the plane the grid of the file is that of the image (PlaneProjection), and nothing is resampled; rows run along the
axis of the scene that points most directly away from the radar, so that shadows fall downwards. On a terrain, where a
plane would put the ground beside its place by its height, the file is orthorectified to longitude and latitude at the
height of each pixel's ground (GeographicProjection, `map_pixels`), north up.

TimeCOAPoly gives the middle of the lit time of a pixel's ground, over rows and columns from the reference point, as the
points of the standard are given; its first coefficient is that of the reference point.
"""
