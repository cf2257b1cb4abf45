"""Sentinel-1 level 0: conversion of space packets to bursts, each a phase history, in one frame.

`packets` reads headers and decodes samples; `ancillary` assembles orbit and attitude from the words that packets carry
one at a time; `bursts` divides the pulses of files where swath, PRF or steering jump, and has the options, the
selection of bursts, and the beam's electronic steering; `histories` makes a phase history of a burst, and `level0`
those of all.
"""
