"""Raw echoes of NISAR: level 0B, Radar Raw Signal Data (RRSD), and other sensors' that are laid out like it (HDF5).

Groups and fields are those of the product specification (JPL D-95646) as files of the mission's emulator have them. An
antenna's frame (RCS) has z along the boresight, x up in elevation and y along the azimuth axis; `quaternions` carry it
into Earth-centred axes. `slantRange` is c / 2 times the delay since transmission began. `UTCtime` is that of transmission
where its description says so; files without one are taken at their word, with a note.
"""
