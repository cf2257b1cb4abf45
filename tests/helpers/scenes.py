"""Scene texts for the end-to-end tests: Table 1's platform with one change each."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import blocksar

TABLE1: dict[str, Any] = {
    "carrier": 15e9,
    "bandwidth": 50e6,
    "range_sampling": 60e6,
    "prf": 8e3,
    "velocity": [-40.0, 1300.0, -600.0],
    "acceleration": [-15.0, -30.0, -35.0],
    "jerk": None,
    "duration": 0.6,
    "pulses": None,
    "start": None,
    "steering": (42.13, 57.87),
    "dwell": 0.162,
    "swath": [29000.0, 31000.0],
    "centre": 50.0,
    "reference_range": '"constant"',
    "more": "",
}

# Each geometry changes Table 1 in one way; physics gives the coefficients that the fit must find.
GEOMETRIES: dict[str, dict[str, Any]] = {
    "table1": {},
    "scan reversed": {"steering": (57.87, 42.13)},
    "other side, mirrored": {
        "velocity": [-40.0, -1300.0, -600.0],
        "acceleration": [-15.0, 30.0, -35.0],
        "steering": (-42.13, -57.87),
        "centre": -50.0,
    },
    "acceleration cancels the Doppler rate": {
        "velocity": [-40.0, -1300.0, -600.0],
        "steering": (-57.87, -42.13),
        "centre": -50.0,
    },
    "track with jerk": {"jerk": [40.0, -80.0, 60.0]},
    "yaw past 90": {"steering": (122.13, 137.87), "centre": 130.0},
    "30-degree scan": {"steering": (35.0, 65.0), "prf": 16e3, "dwell": 0.09},
    "10 GHz, 150 MHz": {"carrier": 10e9, "bandwidth": 150e6, "range_sampling": 180e6, "swath": [29500.0, 30500.0]},
    "35 GHz, 100 MHz": {
        "carrier": 35e9,
        "bandwidth": 100e6,
        "range_sampling": 120e6,
        "prf": 18e3,
        "swath": [29500.0, 30500.0],
    },
    "motion-compensated, odd pulses, t = 0 off centre": {
        "reference_range": '"scene_centre"',
        "pulses": 4801,
        "start": -0.1,
    },
}


# A third of the scan, and a narrow swath: runs take seconds.
SMALL_SCAN: dict[str, Any] = {"steering": (44.75, 55.25), "duration": 0.4, "swath": [29850.0, 30150.0]}


# A beam that is not steered, and a single target: no run needs more than a second.
UNSTEERED_SCENE = """
title = "small"
targets = [{ name = "one", ground_range_offset = 10.0, cross_range_offset = -15.0 }]
[radar]
carrier = 10e9
bandwidth = 100e6
range_sampling = 120e6
prf = 400.0
[track]
position = [0.0, 0.0, 5000.0]
velocity = [0.0, 120.0, 0.0]
[time]
pulses = 160
[scene]
swath = [7920.0, 8080.0]
centre_yaw_deg = 20.0
reference_range = "constant"
"""

# Scenes of papers B and C: the processor of each paper, and the grid of an image, m.
PAPERS: dict[str, tuple[Any, Any]] = {
    "paper_b": ("keystone-resampling", ((10960.0, 11670.0, 0.25), (-1050.0, 1050.0, 0.25))),
    "paper_c": ("high-order-phase", ((17830.0, 18830.0, 0.4), (-800.0, 800.0, 0.4))),
}


def scene(**changes: Any) -> str:
    """Return the text of a scene file."""
    s = {**TABLE1, **changes}
    lines = ['title = "test"', "[radar]"]
    lines += [f"{name} = {float(s[name])}" for name in ("carrier", "bandwidth", "range_sampling", "prf")]
    lines += ["pulse_width = 10e-6", "[track]", "position = [0.0, 0.0, 16500.0]"]
    lines += [f"{name} = {s[name]}" for name in ("velocity", "acceleration", "jerk") if s[name]]
    lines += ["[time]", f"pulses = {s['pulses']}" if s["pulses"] else f"duration = {s['duration']}"]
    if s["start"] is not None:
        lines.append(f"start = {s['start']}")
    if s["steering"]:
        first, last = s["steering"]
        lines += ["[beam]", f"start_deg = {first}", f"stop_deg = {last}", f"dwell = {s['dwell']}"]
    lines += ["[scene]", f"swath = {s['swath']}", f"centre_yaw_deg = {s['centre']}"]
    lines += [f"reference_range = {s['reference_range']}", s["more"]]
    return "\n".join(lines)


def write_store(folder: Path, *, raw: bool = False, **changes: Any) -> Path:
    """Simulate the phase history of such a scene in an existing folder."""
    (folder / "scene.toml").write_text(scene(**changes))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "phase_history.zarr", raw=raw))


def one_target(folder: Path) -> Path:
    """The phase history of Table 1's platform with one target in a narrow swath: a run takes seconds."""
    more = '[[targets]]\nname = "P"\nrange = 30000.0\nyaw_deg = 50.0\n'
    changes = {**SMALL_SCAN, "swath": [29700.0, 30300.0]}
    (folder / "scene.toml").write_text(scene(**changes, more=more))
    return Path(blocksar.simulate(folder / "scene.toml", folder / "phase_history.zarr"))
