"""A small scene and the parameters of its echoes."""

from __future__ import annotations

from typing import Any

from blocksar.simulation.scene import Scene

SCENE = """
title = "small"
[radar]
carrier = 10e9
bandwidth = 100e6
range_sampling = 120e6
prf = 1500
pulse_width = 2e-6
[track]
position = [100.0, 200.0, 3000.0]
velocity = [150.0, 10.0, -20.0]
acceleration = [2.0, 1.0, -3.0]
jerk = [1.0, 0.0, 5.0]
[time]
pulses = 151
[beam]
start_deg = 40
stop_deg = 60
width_deg = 8
[scene]
swath = [9800.0, 10200.0]
ground_height = 12.0
reference_range = "scene_centre"
"""


def chirp(scene: Scene) -> dict[str, Any]:
    width = scene.radar.pulse_width
    assert width is not None
    return {"fast_time": scene.fast_time, "chirp_rate": scene.radar.bandwidth / width, "pulse_width": width}
