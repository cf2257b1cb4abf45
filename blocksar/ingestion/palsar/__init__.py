"""Raw echoes of ALOS PALSAR: CEOS level 1.0, a folder with a leader (LED) and an image file (IMG) a polarisation.

Records and fields are those of the product format description (JAXA) for level 1.0; names are the format's. Two public
readers (isce3, GMTSAR) agree on what it leaves open: a line's time is that of its first sample's reception, cut to
whole milliseconds; the pulse is a down-chirp; a sample's zero is the leader's DC bias. GMTSAR's own calibration, 2.08
ms earlier for the positions, is what this gives: half a way of 2.85 ms, less the half millisecond that cutting takes
off.
"""
