"""Sentinel-1 level 0: space packets to bursts, each a phase history of its own in one frame.

`packets` reads headers, `samples` decodes what they head, `ancillary` has orbit and attitude from the words that
packets carry one at a time, `bursts` divides pulses where swath, PRF or steering jump and has the beam's electronic
law, `histories` makes a phase history of a burst, and `ingestion` those of all.
"""
