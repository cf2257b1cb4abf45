"""The image of a run as a SICD file (Sensor Independent Complex Data, NGA.STND.0024, version 1.3.0), through sarkit.

One file holds the whole image on its ground plane: Grid.Type PLANE, ImagePlane GROUND, ImageFormAlgo OTHER.

Why one ground-plane image. The standard could also hold one file per block, each in its own range-Doppler grid, but its
range-Doppler grids (RGAZIM, RGZERO, INCA) define a pixel's range and Doppler by the formulas of polar format, range
migration or plain azimuth compression. A block's grid, after keystone, fitted perturbation and deramp, follows none of
these. A PLANE grid requires only what holds for a calibrated ground image: pixels are uniform points of a plane, known
in ECEF, and each has a centre of aperture, which for a steered beam depends on its yaw (TimeCOAPoly). Range and Doppler
contours, layover and height sensitivity follow from plane, time and track, and are correct wherever the track is exact.
Block seams need no treatment: every pixel was focused with its own full dwell, whichever block it lies in.
A run of several collections, or segments of a strip, has several tracks, of which the file has that in the middle of
the image; a note tells how many pixels come from others.

An image on a terrain is laid on the plane first, by equal range and Doppler (`plane_image`).

Pixels. Rows of the file run along the axis of the scene, +x, +y, -x or -y, that points most directly away from the
radar, so that shadows fall downwards; columns follow, right-handed about z. Pixels equal those of the image bit for
bit; pixels that are not covered are zero and lie outside ValidData, which bounds the covered ones.

Spatial frequencies. A target at p0 is imaged as mean exp(+4j pi (fc + f)/c (R(p) - R(p0))), with no carrier removed:
about p0 that is exp(+2j pi K . (p - p0)), K = 2 (fc + f)/c times the line of sight along row and column. So Sgn is -1,
and K is not near zero but folded into the band that the spacing SS can hold. KCtr is the multiple of 1/SS nearest to K
at the scene centre point, which is frequency zero of the samples, and DeltaKCOAPoly gives K - KCtr at the centre of
aperture all over the image. Where it leaves +-1/(2 SS) the spectrum wraps, and DeltaK1, DeltaK2 span the whole band, as
the standard requires. ImpRespBW is the extent of K along row and column at the scene centre point, ImpRespWid the -3 dB
width of the cut through a target there. The support of the aperture is not aligned with the axes, so no WgtType is
given of an image without a weighting: it would imply widths of 0.886 / ImpRespBW. Of a weighted image, or under an
antenna's pattern, WgtFunct has the weights along each cut's band, those of the pattern included, and WgtType's
parameters name the tapers along range and azimuth.

Noise. Where the noise of the samples is known, NoisePoly of Radiometric's NoiseLevel has the power of the noise in a
pixel, dB: 0 dB is that of a target of reflectivity 1. The image's reflectivity has no unit of its own, so that scale
factors to radar cross section and sigma nought are not given.
"""
