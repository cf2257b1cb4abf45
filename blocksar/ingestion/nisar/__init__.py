"""Raw echoes of NISAR: level 0B, Radar Raw Signal Data (RRSD), and other sensors' that are laid out like it (HDF5).

Groups and fields are those of files of the mission's emulator. An antenna's frame (RCS) has z along the boresight, x in
elevation and y along the azimuth axis; `quaternions` carry it into Earth-centred axes. `slantRange` is c / 2 times the
delay since transmission began. `UTCtime` is that of transmission where its description says so; where it says nothing,
positions are taken at it, with a note.
"""
