"""Raw echoes in CRSD files (NGA.STND.0080, version 1.0): CRSDsar, of one transmitter and monostatic, with linear FM.

A pulse has the phase PhiX0 + FxFreq0 u + FxRate u^2 / 2 in cycles, u after its centre at TxTime; a vector's sample at t
lacks RefPhi0 + RefFreq (t - RcvStart). An echo that comes after tau thus has

    PhiX0 - RefPhi0 + FxFreq0 (t - TxTime - tau) + FxRate (t - TxTime - tau)^2 / 2 - RefFreq (t - RcvStart) ,

and, with what does not depend on tau taken off, the phase -FxFreq0 tau and the chirp about it, as a raw echo has them.

The phase centre is midway between the transmitter at TxTime and the receiver when the scene's echo arrives, as in CPHD.
"""
